"""Epipolar geometry of uncalibrated pairs, and selection of those that determine a focal length."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from snakesfm.arrays import Array
from snakesfm.geometry.robust import robust_sigma

MAX_POINTS = 400
FEWEST_INLIERS = 20
# pairs that draw more are seldom usable and take most of the time
MAX_HYPOTHESES = 500


@dataclass(frozen=True)
class EpipolarPair:
    """One pair of images with its fundamental matrix.

    Parameters
    ----------
    camera_i, camera_j : rows of the cameras.
    points_i, points_j : (M,2) float64 inliers in pixels from each principal point, at most 400.
    F : (3,3), point_j^T F point_i = 0 for the points above, of unit norm.
    noise_px : robust standard deviation of the inliers' Sampson errors.
    """

    camera_i: int
    camera_j: int
    points_i: Array
    points_j: Array
    F: Array
    noise_px: float


def estimate_epipolar_pair(
    camera_i: int,
    camera_j: int,
    points_i: Array,
    points_j: Array,
    max_error_px: float,
    planar_ratio: float,
    seed: int,
) -> EpipolarPair | None:
    """The fundamental matrix of matched points, or None where it is weak or the scene looks planar.

    Parameters
    ----------
    points_i, points_j : (M,2) matched points in pixels from each principal point, best first.
    max_error_px : epipolar error of an inlier; twice this is allowed to a homography.
    planar_ratio : the pair is refused where a homography explains this share of the inliers.
    """
    # strong distortion cannot be undone everywhere
    finite = np.isfinite(np.hstack([points_i, points_j])).all(axis=1)
    points_i, points_j = points_i[finite], points_j[finite]
    if len(points_i) < FEWEST_INLIERS:
        return None
    F, info = poselib.estimate_fundamental(
        points_i,
        points_j,
        {
            "max_epipolar_error": max_error_px,
            "min_iterations": 100,
            "max_iterations": MAX_HYPOTHESES,
            "progressive_sampling": True,
            "seed": seed,
        },
        {"loss_type": "CAUCHY", "loss_scale": 0.5 * max_error_px},
    )
    inliers = np.array(info["inliers"], dtype=bool)
    if inliers.sum() < max(FEWEST_INLIERS, 0.25 * len(inliers)) or not np.isfinite(F).all():
        return None
    points_i, points_j = points_i[inliers], points_j[inliers]
    _, info = poselib.estimate_homography(
        points_i,
        points_j,
        {"max_reproj_error": 2.0 * max_error_px, "min_iterations": 20, "max_iterations": 200, "seed": seed},
        {},
    )
    if np.sum(info["inliers"]) >= planar_ratio * len(points_i):
        return None
    if len(points_i) > MAX_POINTS:
        rows = np.sort(np.random.default_rng(seed).permutation(len(points_i))[:MAX_POINTS])
        points_i, points_j = points_i[rows], points_j[rows]
    noise_px = robust_sigma(_sampson_errors(F, points_i, points_j), 0.0)
    return EpipolarPair(camera_i, camera_j, points_i, points_j, F / np.linalg.norm(F), noise_px)


def cameras_of(pairs: Sequence[EpipolarPair]) -> Array:
    """The rows of the two cameras of each pair (P,2)."""
    return np.array([(pair.camera_i, pair.camera_j) for pair in pairs], dtype=np.int64).reshape(-1, 2)


def rows_of_cameras(cameras: Array, count: int) -> list[Array]:
    """Rows of the pairs of cameras (P,2) that each of ``count`` cameras is in, ascending."""
    rows = np.arange(len(cameras))
    other = cameras[:, 0] != cameras[:, 1]
    ends = np.concatenate([cameras[:, 0], cameras[other, 1]])
    rows = np.concatenate([rows, rows[other]])
    order = np.lexsort([rows, ends])
    starts = np.searchsorted(ends[order], np.arange(1, count))
    return np.split(rows[order], starts)


def _sampson_errors(F: Array, points_i: Array, points_j: Array) -> Array:
    lines_j = np.column_stack([points_i, np.ones(len(points_i))]) @ F.T
    lines_i = np.column_stack([points_j, np.ones(len(points_j))]) @ F
    algebraic = np.sum(points_j * lines_j[:, :2], axis=1) + lines_j[:, 2]
    errors: Array = algebraic / np.sqrt(np.sum(lines_i[:, :2] ** 2 + lines_j[:, :2] ** 2, axis=1))
    return errors
