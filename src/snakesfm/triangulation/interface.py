"""The interface of triangulators."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.poses import to_camera
from snakesfm.grouping import starts_of


@dataclass(frozen=True)
class TriangulationProblem:
    """Observations of tracks by posed cameras, flat: rows ``offsets[k]:offsets[k+1]`` belong to track k.

    Parameters
    ----------
    rotations, translations : (N,3,3) and (N,3) float64, cam_from_world; every image that is named has one.
    focals_px : (N,) float64, mean focal length, which turns errors on the plane z = 1 into pixels.
    offsets : (T+1,) int64.
    image_ids : (L,) int.
    rays : (L,2) float64, undistorted points on the plane z = 1 of the camera frame.
    """

    rotations: Array
    translations: Array
    focals_px: Array
    offsets: Array
    image_ids: Array
    rays: Array


@dataclass(frozen=True)
class TriangulationLimits:
    """What an observation and a point must fulfil: pixels, degrees, and pairs tried per track."""

    max_reprojection_error_px: float
    min_angle_deg: float
    max_hypotheses: int = 100
    seed: int = 0


class Triangulator(Protocol):
    """Robust triangulation: (T,3) points, NaN where there is none, and (L,) bool inlier observations."""

    def __call__(self, problem: TriangulationProblem, limits: TriangulationLimits) -> tuple[Array, Array]:
        """Triangulate all tracks."""
        ...


def check_points(
    problem: TriangulationProblem, points: Array, limits: TriangulationLimits
) -> tuple[Array, Array]:
    """Points that pass, and the observations that agree with them.

    Parameters
    ----------
    problem : the observations.
    points : (T,3), NaN where there is none.
    limits : largest error in pixels, smallest angle in degrees; depth must be positive.

    Returns
    -------
    points (T,3), NaN where fewer than two observations agree or all their rays are nearly parallel; and
    (L,) bool, the observations that agree.
    """
    count = len(points)
    track_of = np.repeat(np.arange(count), np.diff(problem.offsets))
    rotations = problem.rotations[problem.image_ids]
    in_camera = to_camera(rotations, problem.translations[problem.image_ids], points[track_of])
    depths = in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        offsets = in_camera[:, :2] / depths[:, None] - problem.rays
    errors = np.hypot(offsets[:, 0], offsets[:, 1]) * problem.focals_px[problem.image_ids]
    inliers = (depths > 0) & (errors <= limits.max_reprojection_error_px)
    wide = max_angles(rotations, problem.rays, track_of, inliers, count) >= np.radians(limits.min_angle_deg)
    good = wide & (np.bincount(track_of[inliers], minlength=count) >= 2)
    return np.where(good[:, None], points, np.nan), inliers & good[track_of]


def max_angles(rotations: Array, rays: Array, track_of: Array, used: Array, count: int) -> Array:
    """Widest angle (count,) in radians between the used rays of each track.

    Measured from the ray that lies farthest from the track's mean ray: exact where the rays fan out in one
    direction, never more than the widest angle and never less than half of it.
    """
    directions = np.einsum("lji,lj->li", rotations, np.c_[rays, np.ones(len(rays))])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.nonzero(used)[0]
    widest = np.zeros(count)
    if len(rows) == 0:
        return widest
    tracks, rays_used = track_of[rows], directions[rows]
    mean = np.stack([np.bincount(tracks, rays_used[:, k], count) for k in range(3)], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    chords = np.linalg.norm(rays_used - mean[tracks], axis=1)
    order = np.lexsort((-chords, tracks))
    first = order[starts_of(tracks[order])]
    farthest = np.zeros((count, 3))
    farthest[tracks[first]] = rays_used[first]
    spread = np.linalg.norm(rays_used - farthest[tracks], axis=1)
    np.maximum.at(widest, tracks, 2 * np.arcsin(np.minimum(spread / 2, 1.0)))
    return widest
