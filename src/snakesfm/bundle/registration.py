"""Registration of images that averaging or adjustment left out, by their matches to points of the model."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.reading import read_tracks
from snakesfm.bundle.resection import resect
from snakesfm.geometry.colmap_binding import pycolmap


def register_left_out(
    reconstruction: pycolmap.Reconstruction,
    graph: pycolmap.CorrespondenceGraph,
    max_error_px: float,
    min_inliers: int,
    min_ratio: float,
    max_focals_px: Mapping[int, float],
    seed: int,
    refused: Collection[int] = (),
) -> list[int]:
    """Register the images that have enough matches to points, most matches first, in one pass.

    The inlier matches of the pose that :func:`snakesfm.bundle.resection.resect` finds become observations.

    Parameters
    ----------
    reconstruction : changed in place.
    graph : inlier matches, also of the images that are left out.
    max_error_px : largest reprojection error of an inlier.
    min_inliers, min_ratio : what a pose must have to be accepted.
    max_focals_px : by the id of a camera, how long a focal length may be found for it, if no registered
        image has it; the cameras that are not named keep theirs.
    seed : of RANSAC.
    refused : rows of images that are not tried.

    Returns
    -------
    Rows of the images that were registered.
    """
    left_out = left_out_images(reconstruction, refused)
    if not left_out:
        return []
    observed = _ObservedKeypoints.of(reconstruction)
    if not len(observed.keys):
        return []
    matched = _registered_partners(reconstruction, graph, left_out)
    found = {image: _matched_points(graph, image, others, observed) for image, others in matched.items()}
    in_use = {reconstruction.image(image_id).camera_id for image_id in reconstruction.reg_image_ids()}
    done = []
    for image_id in sorted(left_out, key=lambda image: (-len(found[image]), image)):
        if len(found[image_id]) < min_inliers:
            continue
        camera_id = reconstruction.image(image_id).camera_id
        max_focal_px = 0.0 if camera_id in in_use else max_focals_px.get(camera_id, 0.0)
        if _register(
            reconstruction,
            image_id,
            found[image_id],
            max_error_px,
            min_inliers,
            min_ratio,
            max_focal_px,
            seed,
        ):
            done.append(image_id - 1)
            in_use.add(camera_id)
    return done


def left_out_images(reconstruction: pycolmap.Reconstruction, refused: Collection[int] = ()) -> list[int]:
    """Ids of the images without a pose, but for the rows in ``refused``."""
    settled = set(reconstruction.reg_image_ids()) | {row + 1 for row in refused}
    return sorted(set(reconstruction.images) - settled)


@dataclass(frozen=True)
class _ObservedKeypoints:
    """Which keypoints observe a point.

    Parameters
    ----------
    keys : (L,) int64, ascending, image id times ``factor`` plus keypoint.
    factor : larger than any keypoint.
    points : (L,) int64, id of the point.
    """

    keys: Array
    factor: int
    points: Array

    @classmethod
    def of(cls, reconstruction: pycolmap.Reconstruction) -> "_ObservedKeypoints":
        tracks = read_tracks(reconstruction)
        factor = int(tracks.rows.max(initial=0)) + 1
        keys = (tracks.images + 1) * factor + tracks.rows
        order = np.argsort(keys)
        return cls(keys[order], factor, tracks.ids[tracks.point_rows[order]])

    def look_up(self, image_id: int, rows: Array) -> tuple[Array, Array]:
        """Which keypoints (K,) of an image observe a point, (K,) bool, and the points of those that do."""
        keys = image_id * self.factor + np.minimum(rows, self.factor - 1)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        there = (self.keys[at] == keys) & (rows < self.factor)
        return there, self.points[at[there]]


def _registered_partners(
    reconstruction: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph, images: list[int]
) -> dict[int, list[int]]:
    """The registered images that each of ``images`` has matches with."""
    registered = set(reconstruction.reg_image_ids())
    partners: dict[int, list[int]] = {image: [] for image in images}
    for pair in graph.image_pairs():
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if first in partners and second in registered:
            partners[first].append(second)
        if second in partners and first in registered:
            partners[second].append(first)
    return partners


def _matched_points(
    graph: pycolmap.CorrespondenceGraph, image_id: int, others: list[int], observed: _ObservedKeypoints
) -> Array:
    """Rows (keypoint, point id, votes): for each keypoint the point that most of its matches observe."""
    parts = [np.zeros((0, 2), dtype=np.int64)]
    for other in others:
        matches = graph.extract_matches_between_images(image_id, other)
        mine, theirs = np.asarray(matches, dtype=np.int64).reshape(-1, 2).T
        there, points = observed.look_up(other, theirs)
        parts.append(np.stack([mine[there], points], axis=1))
    votes, counts = np.unique(np.concatenate(parts), axis=0, return_counts=True)
    table = np.column_stack([votes, counts]).astype(np.int64)
    # of each keypoint the point with most votes; then, as an image sees a point once, of each point the
    # keypoint with most votes
    for column in (0, 1):
        order = np.lexsort((table[:, 1 - column], -table[:, 2], table[:, column]))
        first = np.unique(table[order, column], return_index=True)[1]
        table = table[order[first]]
    return np.asarray(table[np.argsort(table[:, 0])])


def _register(
    reconstruction: pycolmap.Reconstruction,
    image_id: int,
    matched: Array,
    max_error_px: float,
    min_inliers: int,
    min_ratio: float,
    max_focal_px: float,
    seed: int,
) -> bool:
    image = reconstruction.image(image_id)
    camera = reconstruction.camera(image.camera_id)
    pixels = np.array([image.point2D(int(row)).xy for row in matched[:, 0]])
    points = np.array([reconstruction.point3D(int(point)).xyz for point in matched[:, 1]])
    found = resect(camera, pixels, points, max_error_px, max_focal_px, seed)
    if found.support < max(min_inliers, min_ratio * len(matched)):
        return False
    camera.params = found.camera.params
    image.frame.set_cam_from_world(image.camera_id, found.pose)
    reconstruction.register_frame(image.frame_id)
    for row, point, _ in matched[found.inliers].tolist():
        reconstruction.add_observation(point, pycolmap.TrackElement(image_id, row))
    return True
