"""Test of which camera centres the measurements determine, and how well."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import sum_by
from snakesfm.translation_averaging.landmarks import (
    angles_rad,
    edge_angles_rad,
    intersect,
    locate_landmarks,
    perpendicular,
    usual_error_rad,
)
from snakesfm.translation_averaging.problem import PositioningProblem

TELLING_SIGHTS = 3
RAY_SIGMAS = 4.0


@dataclass(frozen=True)
class SupportLimits:
    """What a camera must show to keep its centre.

    Parameters
    ----------
    sigma_rad : standard deviation of a ray, or more if the scene's median residual is larger; rays count
        that are within four of them.
    edge_rad : edges count whose direction is within this angle.
    min_support : rays that count; or a third as many edges, for a camera without that many rays.
    min_ratio : share of the camera's rays that count; half of it is asked of its edges.
    max_relative_sigma : standard deviation of the centre, landmarks and other cameras being fixed, over the
        median length of the rays that count.
    """

    sigma_rad: float
    edge_rad: float
    min_support: int
    min_ratio: float
    max_relative_sigma: float

    @property
    def ray_rad(self) -> float:
        """Angle within which a ray counts."""
        return RAY_SIGMAS * self.sigma_rad


def held_cameras(
    problem: PositioningProblem, centers: Array, points: Array, limits: SupportLimits
) -> Array:
    """Mask (N) of the cameras whose centre enough rays, or enough edges, hold in place.

    Rays to landmarks that fewer than two other cameras see tell no more than the edge to these.
    """
    count = problem.image_count
    located = np.isfinite(centers[problem.ray_images, 0]) & np.isfinite(points[problem.ray_tracks, 0])
    sights = np.bincount(problem.ray_tracks[located], minlength=len(points))
    problem = problem.select_rays(located & (sights[problem.ray_tracks] >= TELLING_SIGHTS))
    angles = angles_rad(problem, centers, points)
    # Where the averaged rotations are poor everywhere, one camera must not be better than the rest.
    sigma = usual_error_rad(angles, limits.sigma_rad)
    by_rays = _held(
        problem.ray_images,
        angles < RAY_SIGMAS * sigma,
        points[problem.ray_tracks] - centers[problem.ray_images],
        sigma,
        limits.min_support,
        limits.min_ratio,
        limits,
        count,
    )
    # An edge constrains both of its cameras.
    ends = problem.pairs.T.ravel()
    vectors = centers[problem.pairs[:, 1]] - centers[problem.pairs[:, 0]]
    by_edges = _held(
        ends,
        np.tile(edge_angles_rad(problem, centers) < limits.edge_rad, 2),
        np.concatenate([vectors, -vectors]),
        limits.edge_rad / 4.0,
        max(2, (limits.min_support + 2) // 3),
        limits.min_ratio / 2.0,
        limits,
        count,
    )
    rays = np.bincount(problem.ray_images, minlength=count)
    # Rays decide where there are enough to decide.
    return np.where(rays >= limits.min_support, by_rays, by_edges)


def _held(
    groups: Array,
    agree: Array,
    offsets: Array,
    sigma_rad: float,
    min_support: int,
    min_ratio: float,
    limits: SupportLimits,
    count: int,
) -> Array:
    lengths = np.linalg.norm(offsets, axis=1)
    agree = agree & np.isfinite(lengths) & (lengths > 0)
    total = np.bincount(groups, minlength=count)
    support = np.bincount(groups[agree], minlength=count)
    groups, offsets, lengths = groups[agree], offsets[agree], lengths[agree]
    blocks = perpendicular(offsets / lengths[:, None]) / (sigma_rad * lengths)[:, None, None] ** 2
    information = np.linalg.eigvalsh(sum_by(blocks, groups, count))[:, 0]
    order = np.lexsort((lengths, groups))
    starts = np.searchsorted(groups[order], np.arange(count))
    typical = np.zeros(count)
    some = support > 0
    typical[some] = lengths[order][(starts + support // 2)[some]]
    firm = information * (limits.max_relative_sigma * typical) ** 2 > 1.0
    return np.asarray(firm & (support >= min_support) & (support >= min_ratio * total))


def attach_cameras(
    problem: PositioningProblem, centers: Array, held: Array, limits: SupportLimits
) -> Array:
    """Centres (N,3) of the held cameras, and of those others that the held ones and their landmarks fix.

    A camera of known rotation is where the lines through its landmarks, against its rays, and through its
    neighbours, along its edges, meet. NaN where they do not.
    """
    centers = np.where(held[:, None], centers, np.nan)
    waiting = np.zeros(problem.image_count, dtype=bool)
    waiting[problem.images()] = True
    waiting &= ~held
    points = locate_landmarks(problem, centers)
    while waiting.any() and not waiting.all():
        known = np.isfinite(centers[:, 0])
        rays = waiting[problem.ray_images] & np.isfinite(points[problem.ray_tracks, 0])
        forth = waiting[problem.pairs[:, 1]] & known[problem.pairs[:, 0]]
        back = waiting[problem.pairs[:, 0]] & known[problem.pairs[:, 1]]
        origins = np.concatenate(
            [
                points[problem.ray_tracks[rays]],
                centers[problem.pairs[forth, 0]],
                centers[problem.pairs[back, 1]],
            ]
        )
        lines = np.concatenate([-problem.rays[rays], problem.directions[forth], -problem.directions[back]])
        groups = np.concatenate([problem.ray_images[rays], problem.pairs[forth, 1], problem.pairs[back, 0]])
        found = intersect(origins, lines, groups, problem.image_count)
        trial = np.where(waiting[:, None], found, centers)
        good = waiting & held_cameras(problem, trial, points, limits)
        if not good.any():
            break
        centers[good] = trial[good]
        waiting &= ~good
        # landmarks that no new camera sees stay where they are: a chain of cameras takes a pass for each
        seen = np.isin(problem.ray_tracks, problem.ray_tracks[good[problem.ray_images]])
        again, tracks = problem.select_rays(seen).number_tracks()
        points[tracks] = locate_landmarks(again, centers)
    return centers
