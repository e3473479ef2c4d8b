"""From directions to checked centres: first guess, refinement, weak cameras, gauge, residuals."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of
from snakesfm.translation_averaging.angular import refine_angles
from snakesfm.translation_averaging.averagers import GlobalPositioning, TranslationAverager, with_rays
from snakesfm.translation_averaging.landmarks import angles_rad, edge_angles_rad, intersect
from snakesfm.translation_averaging.problem import PositioningProblem
from snakesfm.translation_averaging.support import SupportLimits, attach_cameras, held_cameras

DOUBTFUL_SHARE = 0.75
"""Of the rays: in the scenes at hand .84 and more agree with right positions, .38 to .71 with folded."""
# positions with which fewer agree are no better than none
LEAST_SHARE = 0.6
MORE_RAYS = 15
# in all: global positioning takes a few seconds for so many
MOST_RAYS = 500_000


@dataclass(frozen=True)
class PositioningSettings:
    """How cameras are positioned.

    Parameters
    ----------
    averager : gives the first positions.
    limits : what holds a camera in place.
    refine : whether the first positions are refined by the angles of rays and edges.
    rays_per_camera : about how many take part.
    restarts : random starts that are tried where few rays agree with the positions.
    restart : what starts, given more rays.
    seed : of what is drawn.
    """

    averager: TranslationAverager
    limits: SupportLimits
    refine: bool
    rays_per_camera: int
    restarts: int
    restart: GlobalPositioning
    seed: int


@dataclass(frozen=True)
class AveragedCenters:
    """Centres of N cameras, and how well E edges and Q rays agree with them."""

    centers: Array
    """(N,3), NaN where there is none; the median edge is one unit long and the median centre the origin."""
    edge_residuals_rad: Array
    """(E) NaN where a centre is missing."""
    ray_residuals_rad: Array
    """(Q) of the rays that took part."""


def position_components(
    problem: PositioningProblem, components: Array, settings: PositioningSettings
) -> AveragedCenters:
    """Position the cameras of each component (N,) of the images, -1 for none, in its own frame."""
    centers = np.full((problem.image_count, 3), np.nan)
    edge_residuals = np.full(len(problem.pairs), np.nan)
    rays = []
    for component in range(max(1, int(components.max(initial=-1)) + 1)):
        mine = components == component
        edges = mine[problem.pairs].all(axis=1)
        part = problem.select_edges(edges).select_rays(mine[problem.ray_images])
        found = average_translations(part, settings)
        centers[mine] = found.centers[mine]
        edge_residuals[edges] = found.edge_residuals_rad
        rays.append(found.ray_residuals_rad)
    return AveragedCenters(centers, edge_residuals, np.concatenate(rays))


def average_translations(problem: PositioningProblem, settings: PositioningSettings) -> AveragedCenters:
    """Position the cameras of the largest connected part.

    A camera that its rays and edges do not hold in place is positioned again from the others, and gets no
    centre if that does not hold either: weakly seen cameras are otherwise thrown far away.

    Where few rays agree with the positions, as of facades that repeat, random starts of global positioning
    with more rays are tried, and the positions are kept with which most of all rays agree.
    """
    limits = settings.limits
    part = largest_part(problem)
    thinned = with_rays(part, settings.rays_per_camera)
    # what is worked out per track must cost as much as there are rays, not as the highest number tells
    chosen = thinned.number_tracks()[0]
    images = part.images()
    if len(images) < 2:
        centers = np.full((problem.image_count, 3), np.nan)
    elif len(images) == 2 and len(part.pairs):
        centers = np.full((problem.image_count, 3), np.nan)
        centers[part.pairs[0, 0]] = 0.0
        centers[part.pairs[0, 1]] = part.directions[0]
    else:
        first = settings.averager.position(thinned, settings.seed)
        centers = _checked_positions(chosen, first, settings)
        if settings.restarts and agreeing_share(chosen, centers, limits) < DOUBTFUL_SHARE:
            # look-alikes make wrong edges and the longest tracks: more rays, without edges, may agree
            few = settings.rays_per_camera
            many = max(few, min(MORE_RAYS * few, MOST_RAYS // len(images)))
            more, whole = with_rays(part, many).number_tracks()[0], part.number_tracks()[0]
            best = max(agreeing_share(whole, centers, limits), LEAST_SHARE)
            for start in range(settings.restarts):
                other = settings.restart.position(more, settings.seed + start)
                other = _checked_positions(more, other, settings)
                share = agreeing_share(whole, other, limits)
                if share > best:
                    chosen, centers, best = more, other, share
    centers = normalize_gauge(part, centers)
    seen = chosen.select_rays(np.isfinite(centers[chosen.ray_images, 0]))
    points = _landmarks(seen, centers)
    return AveragedCenters(
        centers=centers,
        edge_residuals_rad=edge_angles_rad(problem, centers),
        ray_residuals_rad=angles_rad(seen, centers, points),
    )


def agreeing_share(problem: PositioningProblem, centers: Array, limits: SupportLimits) -> float:
    """Share of the rays that pass by their landmarks within the limit of a ray.

    Rays of images without a centre do not; the share of no rays is 1.
    """
    known = np.isfinite(centers[problem.ray_images, 0])
    if not known.any():
        return float(not len(known))
    seen = problem.select_rays(known)
    angles = angles_rad(seen, centers, _landmarks(seen, centers))
    return float(np.count_nonzero(angles < limits.ray_rad) / len(known))


def largest_part(problem: PositioningProblem) -> PositioningProblem:
    """The edges and rays of the largest set of images that edges or tracks connect."""
    tracks, track_node = np.unique(problem.ray_tracks, return_inverse=True)
    count = problem.image_count + len(tracks)
    seen = np.column_stack([problem.ray_images, problem.image_count + track_node])
    labels = components_of(count, np.concatenate([problem.pairs, seen]))[: problem.image_count]
    main = labels == np.argmax(np.bincount(labels)) if problem.image_count else np.zeros(0, dtype=bool)
    return problem.select_edges(main[problem.pairs[:, 0]]).select_rays(main[problem.ray_images])


def normalize_gauge(problem: PositioningProblem, centers: Array) -> Array:
    """Centres moved and scaled: the median edge has length one, the median of the centres is the origin."""
    known = np.isfinite(centers[:, 0])
    if not known.any():
        return centers
    lengths = np.linalg.norm(centers[problem.pairs[:, 1]] - centers[problem.pairs[:, 0]], axis=1)
    lengths = lengths[np.isfinite(lengths) & (lengths > 0)]
    scale = float(np.median(lengths)) if len(lengths) else 1.0
    return np.asarray((centers - np.median(centers[known], axis=0)) / scale)


def _checked_positions(problem: PositioningProblem, centers: Array, settings: PositioningSettings) -> Array:
    """First positions (N,3) refined, without the cameras that nothing holds in place."""
    if settings.refine:
        centers = _refined(problem, centers, settings)
    checked = _checked(problem, centers, settings.limits)
    # cameras that moved or went away may have bent their neighbourhood
    if settings.refine and not np.array_equal(checked, centers, equal_nan=True):
        checked = _refined(problem, checked, settings)
        checked = _checked(problem, checked, settings.limits, attach=False)
    return checked


def _landmarks(problem: PositioningProblem, centers: Array) -> Array:
    size = int(problem.ray_tracks.max(initial=-1)) + 1
    return intersect(centers[problem.ray_images], problem.rays, problem.ray_tracks, size)


def _refined(problem: PositioningProblem, centers: Array, settings: PositioningSettings) -> Array:
    start = normalize_gauge(problem, centers)
    return refine_angles(problem, start, settings.limits.sigma_rad)[0]


def _checked(
    problem: PositioningProblem, centers: Array, limits: SupportLimits, attach: bool = True
) -> Array:
    known = np.isfinite(centers[:, 0])
    points = _landmarks(problem.select_rays(known[problem.ray_images]), centers)
    # Rays of images without centre may point to higher tracks than the triangulated ones.
    size = int(problem.ray_tracks.max(initial=-1)) + 1
    points = np.concatenate([points, np.full((size - len(points), 3), np.nan)])
    held = known & held_cameras(problem, centers, points, limits)
    if attach:
        return attach_cameras(problem, centers, held, limits)
    return np.where(held[:, None], centers, np.nan)
