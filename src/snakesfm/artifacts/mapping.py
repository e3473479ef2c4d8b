"""Artifacts of the averagings, the tracks and the bundle adjustment."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.base import Artifact, column
from snakesfm.grouping import offsets_of


@dataclass(frozen=True)
class CameraRotations(Artifact):
    """Averaged rotations."""

    kind: ClassVar[str] = "camera_rotations"
    format_version: ClassVar[int] = 2

    rotations: Array = column("(N,3,3)", "float64", "cam_from_world; NaN where the image has none")
    residuals_deg: Array = column("(E)", "float64", "per edge of the view graph, NaN where not compared")
    labels: Array = column("(E)", "int8", "label of the edge after averaging, as in view_graph")
    components: Array = column(
        "(N)", "int32", "images of one component share a coordinate frame; 0 the largest, -1 none"
    )


@dataclass(frozen=True)
class TrackTable(Artifact):
    """Tracks: sets of keypoints that show one point, sorted by image within a track."""

    kind: ClassVar[str] = "tracks"
    format_version: ClassVar[int] = 3

    offsets: Array = column("(T+1)", "int64", "rows offsets[k]:offsets[k+1] belong to track k")
    image_ids: Array = column("(L)", "int32", "row of the image in the index")
    keypoint_ids: Array = column("(L)", "int32", "row of the keypoint in its image")
    part_ids: Array = column("(L)", "int32", "part of a track that is connected by confirmed matches")
    keypoints: Array = column("(L,2)", "float32", "x, y in original pixels")
    colors: Array = column("(L,3)", "uint8", "RGB of the image at the keypoint")
    lengths_unmerged: Array = column(
        "(U)",
        "int64",
        "detector-free: entry k is the number of tracks in k images if inlier matches are joined before "
        "merging; else empty",
    )
    lengths_merged: Array = column("(V)", "int64", "the same in merged keypoints, before splitting")


@dataclass(frozen=True)
class CameraCenters(Artifact):
    """Averaged camera centres."""

    kind: ClassVar[str] = "camera_centers"
    format_version: ClassVar[int] = 3

    centers: Array = column("(N,3)", "float64", "camera centre in the world; NaN where there is none")
    components: Array = column(
        "(N)", "int32", "images of one component share origin and scale; 0 the largest, -1 no centre"
    )
    edge_residuals_deg: Array = column(
        "(E)",
        "float64",
        "angle of the edge's direction to the centres, NaN for edges that took no part or join components",
    )
    ray_residuals_deg: Array = column("(Q)", "float64", "angle of each ray that took part to its landmark")


@dataclass(frozen=True)
class TriangulatedPoints(Artifact):
    """Points with the observations that agree with them."""

    kind: ClassVar[str] = "triangulated_points"

    points: Array = column("(T,3)", "float64", "point in the world")
    offsets: Array = column("(T+1)", "int64", "rows offsets[k]:offsets[k+1] belong to point k")
    image_ids: Array = column("(L)", "int32", "row of the image in the index")
    keypoint_ids: Array = column("(L)", "int32", "row of the keypoint in its image")
    keypoints: Array = column("(L,2)", "float32", "x, y in original pixels")
    colors: Array = column("(T,3)", "uint8", "mean RGB of the observations")


@dataclass(frozen=True)
class Reconstruction(Artifact):
    """The adjusted model: cameras, poses, points and observations."""

    kind: ClassVar[str] = "reconstruction"
    format_version: ClassVar[int] = 6

    camera_models: Array = column("(C)", "str", "COLMAP camera model name")
    camera_sizes: Array = column("(C,2)", "int32", "width and height in pixels")
    camera_params: Array = column("(C,16)", "float64", "COLMAP parameters in pixels, padded with NaN")
    camera_resets: Array = column(
        "(C)", "str", "implausible parameter for which the last pass reset and fixed the camera; else empty"
    )
    camera_offsets: Array = column(
        "(C)",
        "float64",
        "how far off a principal point seems that was left, relative to the longer side",
    )
    camera_spreads: Array = column(
        "(C)", "float64", "by how much the images of a camera seem to differ in focal length, NaN if not"
    )
    rotations: Array = column("(N,3,3)", "float64", "cam_from_world; NaN where not registered")
    translations: Array = column("(N,3)", "float64", "cam_from_world; NaN where not registered")
    models: Array = column(
        "(N)", "int32", "images of one model share a coordinate frame; 0 the largest, -1 none"
    )
    points: Array = column("(T,3)", "float64", "point in the world")
    colors: Array = column("(T,3)", "uint8", "mean RGB of the observations")
    errors_px: Array = column("(T)", "float64", "mean reprojection error of the point")
    offsets: Array = column("(T+1)", "int64", "rows offsets[k]:offsets[k+1] belong to point k")
    image_ids: Array = column("(L)", "int32", "row of the image in the index")
    keypoint_ids: Array = column("(L)", "int32", "row of the keypoint in its image")
    keypoints: Array = column("(L,2)", "float32", "x, y in original pixels")
    round_names: Array = column("(B)", "str", "what each round of the adjustment did")
    round_costs: Array = column("(B,2)", "float64", "robust cost before and after the round")
    round_counts: Array = column("(B,3)", "int64", "images, points and observations after the round")
    round_errors_px: Array = column(
        "(B)", "float64", "mean reprojection error after the round, in detector pixels"
    )

    @property
    def model_count(self) -> int:
        """How many models there are, each in its own coordinate frame."""
        return int(self.models.max(initial=-1)) + 1

    def select_model(self, number: int) -> "Reconstruction":
        """The poses, points and observations of one model alone; cameras and rounds stay as they are."""
        mine = self.models == number
        # a point is seen by images of one model only
        points = mine[self.image_ids[self.offsets[:-1]]]
        lengths = np.diff(self.offsets)
        rows = np.repeat(points, lengths)
        return replace(
            self,
            rotations=np.where(mine[:, None, None], self.rotations, np.nan),
            translations=np.where(mine[:, None], self.translations, np.nan),
            models=np.where(mine, self.models, -1),
            points=self.points[points],
            colors=self.colors[points],
            errors_px=self.errors_px[points],
            offsets=offsets_of(lengths[points]),
            image_ids=self.image_ids[rows],
            keypoint_ids=self.keypoint_ids[rows],
            keypoints=self.keypoints[rows],
        )
