"""Landmarks of known cameras: which tracks to use, and where the landmarks are."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import sum_by
from snakesfm.translation_averaging.problem import PositioningProblem


def cover_cameras(ray_images: Array, ray_tracks: Array, image_count: int, rays_per_camera: int) -> Array:
    """Mask (Q) of the rays of tracks that give each camera ``rays_per_camera`` rays, long tracks first.

    Greedy cover as in 1DSfM (Wilson and Snavely, ECCV 2014, section 5): a track is taken when one of its
    cameras still lacks rays. Ties go to the lower track.
    """
    tracks, starts, lengths = np.unique(ray_tracks, return_index=True, return_counts=True)
    lack = [rays_per_camera] * image_count
    images = ray_images.tolist()
    chosen = np.zeros(len(tracks), dtype=bool)
    order = np.lexsort((tracks, -lengths))
    order = order[lengths[order] >= 2]
    ends = (starts + lengths)[order].tolist()
    for k, start, end in zip(order.tolist(), starts[order].tolist(), ends, strict=True):
        row = images[start:end]
        if max(map(lack.__getitem__, row)) > 0:
            chosen[k] = True
            for i in row:
                lack[i] -= 1
    return np.asarray(np.repeat(chosen, lengths))


def perpendicular(rays: Array) -> Array:
    """Projections (Q,3,3) onto the planes across unit vectors (Q,3)."""
    return np.asarray(np.eye(3) - rays[:, :, None] * rays[:, None, :])


def intersect(origins: Array, rays: Array, groups: Array, count: int, rounds: int = 5) -> Array:
    """Points (count,3) nearest to the lines of each group, by angle and robustly; NaN where undetermined.

    Iteratively reweighted least squares on the distance to the line over the distance to its origin. It
    triangulates landmarks (lines from cameras) and places cameras (lines from landmarks).
    """
    across = perpendicular(rays)
    targets = np.einsum("qij,qj->qi", across, origins)
    weights = np.ones(len(rays))
    points = np.full((count, 3), np.nan)
    for _ in range(rounds):
        normal = sum_by(across * weights[:, None, None], groups, count)
        right = sum_by(targets * weights[:, None], groups, count)
        trace = np.trace(normal, axis1=1, axis2=2)
        smallest = np.linalg.eigvalsh(normal)[:, 0]
        known = smallest > 1e-9 * np.maximum(trace, 1e-300)
        points[known] = np.linalg.solve(normal[known], right[known][:, :, None])[:, :, 0]
        points[~known] = np.nan
        offsets = points[groups] - origins
        distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
        miss = np.linalg.norm(np.einsum("qij,qj->qi", across, offsets), axis=1) / distance
        behind = np.einsum("qi,qi->q", offsets, rays) < 0
        scale = np.radians(0.5)
        robust = 1.0 / (1.0 + (miss / scale) ** 2)
        weights = np.where(np.isfinite(miss), np.where(behind, 0.01, 1.0) * robust / distance**2, 0.0)
    return points


def locate_landmarks(problem: PositioningProblem, centers: Array) -> Array:
    """Landmarks (max track + 1, 3) from the rays of cameras with a centre; NaN where these do not tell."""
    seen = problem.select_rays(np.isfinite(centers[problem.ray_images, 0]))
    size = int(problem.ray_tracks.max(initial=-1)) + 1
    return intersect(centers[seen.ray_images], seen.rays, seen.ray_tracks, size)


def angles_rad(problem: PositioningProblem, centers: Array, points: Array) -> Array:
    """Angles (Q) between the rays and the directions to their landmarks ``points[ray_tracks]``."""
    offsets = points[problem.ray_tracks] - centers[problem.ray_images]
    cross = np.linalg.norm(np.cross(offsets, problem.rays), axis=1)
    return np.asarray(np.arctan2(cross, np.einsum("qi,qi->q", offsets, problem.rays)))


def usual_error_rad(angles: Array, least_rad: float) -> float:
    """Standard deviation that residual angles (Q) show, at least ``least_rad``; NaN ones do not count."""
    angles = angles[np.isfinite(angles)]
    return max(least_rad, 1.5 * float(np.median(angles))) if len(angles) else least_rad


def edge_angles_rad(problem: PositioningProblem, centers: Array) -> Array:
    """Angles (E) between the edges' directions and those between the centres; NaN where one is missing."""
    baselines = centers[problem.pairs[:, 1]] - centers[problem.pairs[:, 0]]
    cross = np.linalg.norm(np.cross(baselines, problem.directions), axis=1)
    return np.asarray(np.arctan2(cross, np.einsum("ei,ei->e", baselines, problem.directions)))
