"""Triangulation of all tracks of a scene, with a triangulator by name."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera, undistort
from snakesfm.geometry.poses import has_pose
from snakesfm.grouping import offsets_of
from snakesfm.triangulation.interface import TriangulationLimits, TriangulationProblem, Triangulator

Method = Literal["ransac_dlt", "pycolmap"]


def triangulator(method: Method) -> Triangulator:
    """The triangulator of a name."""
    if method == "pycolmap":
        from snakesfm.triangulation.lo_ransac import triangulate_pycolmap

        return triangulate_pycolmap
    from snakesfm.triangulation.ransac_dlt import triangulate_ransac_dlt

    return triangulate_ransac_dlt


def triangulate_tracks(
    cameras: Sequence[Camera],
    camera_ids: Array,
    rotations: Array,
    translations: Array,
    offsets: Array,
    image_ids: Array,
    keypoints: Array,
    limits: TriangulationLimits,
    method: Method = "ransac_dlt",
    min_length: int = 2,
) -> tuple[Array, Array]:
    """Points of tracks, robust to wrong observations.

    Parameters
    ----------
    cameras : intrinsics.
    camera_ids : (N,) int, camera of each image.
    rotations, translations : (N,3,3), (N,3) cam_from_world; images with NaN are skipped.
    offsets : (T+1,) int64, rows ``offsets[k]:offsets[k+1]`` of the next two belong to track k.
    image_ids : (L,) int.
    keypoints : (L,2) pixels.
    limits : largest reprojection error in pixels, smallest angle in degrees, hypotheses and seed.
    method : ``ransac_dlt`` or ``pycolmap``.
    min_length : observations that a point must keep.

    Returns
    -------
    points (T,3) in the world, NaN where there is none; and (L,) bool, the observations of the points.
    """
    rays = undistort(cameras, camera_ids, image_ids, keypoints)
    usable = has_pose(rotations, translations)[image_ids] & np.isfinite(rays).all(axis=1)
    track_of = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    lengths = np.bincount(track_of[usable], minlength=len(offsets) - 1)
    focals = np.array([camera.focal_px for camera in cameras])[camera_ids]
    problem = TriangulationProblem(
        rotations, translations, focals, offsets_of(lengths), image_ids[usable], rays[usable]
    )
    points, inliers = triangulator(method)(problem, limits)
    kept = np.zeros(len(image_ids), dtype=bool)
    kept[usable] = inliers
    short = np.bincount(track_of[kept], minlength=len(points)) < min_length
    points[short] = np.nan
    return points, kept & ~short[track_of]


def mean_colors(colors: Array, offsets: Array) -> Array:
    """Mean RGB (T,3) uint8 of flat observations (L,3); every point has at least one."""
    if len(offsets) == 1:
        return np.zeros((0, 3), dtype=np.uint8)
    sums = np.add.reduceat(colors.astype(np.float64), offsets[:-1], axis=0)
    return np.round(sums / np.diff(offsets)[:, None]).astype(np.uint8)
