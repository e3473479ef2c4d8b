"""Stage triangulate_tracks: points from tracks and averaged poses."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.mapping import CameraCenters, CameraRotations, TrackTable, TriangulatedPoints
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import cameras_from_columns
from snakesfm.geometry.detector_pixels import detector_scales, reduce_cameras
from snakesfm.geometry.poses import has_pose, translation_of
from snakesfm.grouping import offsets_of, starts_of
from snakesfm.stages.job import StageJob
from snakesfm.triangulation.interface import TriangulationLimits
from snakesfm.triangulation.tracks import mean_colors, triangulate_tracks

if TYPE_CHECKING:
    from snakesfm.config.triangulate_tracks import TriangulateTracksOptions

# of the tracks: mismatches gave .004 of those of a still camera a point, real sets have .86 and more
LEAST_SHARE = 0.02


def run(job: StageJob) -> None:
    """Triangulate every track between images that have a rotation and a centre, in each frame by itself.

    Raises
    ------
    SceneError : next to no track gives a point, or no two images with a pose share one.
    """
    options: TriangulateTracksOptions = job.options
    index = ImageIndex.read(job.path("index"))
    cameras = cameras_from_columns(*CalibratedCameras.read(job.path("cameras")).camera_columns)
    rotations = CameraRotations.read(job.path("rotations")).rotations
    averaged = CameraCenters.read(job.path("centers"))
    tracks = split_by_frame(TrackTable.read(job.path("tracks")), averaged.components)
    scales = detector_scales(index.sizes, job.settings).astype(np.float32)
    translations = translation_of(rotations, averaged.centers)
    points, kept = triangulate_tracks(
        reduce_cameras(cameras, job.settings),
        index.camera_ids,
        rotations,
        translations,
        tracks.offsets,
        tracks.image_ids,
        tracks.keypoints / scales[tracks.image_ids, None],
        TriangulationLimits(
            options.max_reprojection_error_px,
            options.min_angle_deg,
            options.max_hypotheses,
            job.seed_for("triangulation"),
        ),
        options.method,
        options.min_length,
    )
    count = len(tracks.offsets) - 1
    good = np.isfinite(points[:, 0])
    posed = has_pose(rotations, translations)[tracks.image_ids]
    seen_twice = int(np.count_nonzero(np.add.reduceat(posed, tracks.offsets[:-1], dtype=np.int64) > 1))
    if seen_twice == 0:
        raise SceneError(
            f"Scene '{job.scene}': none of the {count} tracks is seen by two images with a position: see in"
            " the logs of average_rotations and average_translations how many images they placed, add some"
            " with more overlap, or try another average_translations.method."
        )
    if good.sum() <= LEAST_SHARE * seen_twice:
        raise SceneError(
            f"Scene '{job.scene}': {good.sum()} of {seen_twice} tracks can be triangulated with averaged"
            " poses: photographs all taken from one position, as for a panorama or by a camera on a tripod,"
            " show no depth; add some from other positions. Otherwise check the cameras' focal lengths, or"
            " lower triangulate_tracks.min_angle_deg or raise its max_reprojection_error_px."
        )
    lengths = np.add.reduceat(kept.astype(np.int64), tracks.offsets[:-1])[good]
    offsets = offsets_of(lengths)
    print(f"{good.sum()} points of {count} tracks, {kept.sum()} of {len(kept)} observations")
    TriangulatedPoints(
        points=points[good],
        offsets=offsets,
        image_ids=tracks.image_ids[kept],
        keypoint_ids=tracks.keypoint_ids[kept],
        keypoints=tracks.keypoints[kept],
        colors=mean_colors(tracks.colors[kept], offsets),
    ).write(job.output, job.header)


def split_by_frame(tracks: TrackTable, components: np.ndarray) -> TrackTable:
    """Tracks of images of several components (N,), each a coordinate frame, as one for each of them."""
    track_of = np.repeat(np.arange(len(tracks.offsets) - 1), np.diff(tracks.offsets))
    # images without a centre tell nothing, so they need no track of their own
    frames = np.maximum(components, 0)[tracks.image_ids]
    order = np.lexsort((frames, track_of))
    starts = np.flatnonzero(starts_of(track_of[order], frames[order]))
    return replace(
        tracks,
        offsets=np.append(starts, len(order)),
        image_ids=tracks.image_ids[order],
        keypoint_ids=tracks.keypoint_ids[order],
        part_ids=tracks.part_ids[order],
        keypoints=tracks.keypoints[order],
        colors=tracks.colors[order],
    )
