"""From directions to checked centres: first guess, refinement, weak cameras, gauge, residuals."""

from dataclasses import dataclass, replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of
from snakesfm.translation_averaging.angular import refine_angles
from snakesfm.translation_averaging.averagers import GlobalPositioning, TranslationAverager, with_rays
from snakesfm.translation_averaging.landmarks import angles_rad, edge_angles_rad, locate_landmarks
from snakesfm.translation_averaging.problem import PositioningProblem
from snakesfm.translation_averaging.support import SupportLimits, attach_cameras, held_cameras

DOUBTFUL_SHARE = 0.75
"""Of the rays: in the scenes at hand .84 and more agree with right positions, .38 to .71 with folded."""
# positions with which fewer agree are no better than none
LEAST_SHARE = 0.6
MORE_RAYS = 15
# in all: global positioning takes most of a minute for so many, and is tried several times
MOST_RAYS = 200_000


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
    """Centres of N cameras, and how well Q rays agree with them."""

    centers: Array
    """(N,3), NaN where there is none; the median edge is one unit long and the median centre the origin."""
    ray_residuals_rad: Array
    """(Q) of the rays that took part, NaN where a centre is missing."""
    ray_images: Array
    """(Q)."""

    @property
    def placed(self) -> Array:
        """Which images (N,) bool have a centre."""
        return np.isfinite(self.centers[:, 0])


@dataclass(frozen=True)
class PositionedComponents:
    """Centres of N cameras in frames of C components, and how well E edges and Q rays agree with them."""

    centers: Array
    """(N,3), NaN where there is none; each component as of :class:`AveragedCenters`."""
    components: Array
    """(N,) int32 of the images with a centre, 0 the largest; -1 for others."""
    edge_residuals_rad: Array
    """(E) NaN where a centre is missing, and between components."""
    ray_residuals_rad: Array
    """(Q) of the rays that took part and whose image has a centre."""
    agreeing: tuple[float, ...]
    """(C) share of the rays that agree; those of images that were left out do not."""


def position_components(
    problem: PositioningProblem, components: Array, settings: PositioningSettings, min_images: int
) -> PositionedComponents:
    """Position the cameras of each component (N,) of the images, -1 for none, in its own frame.

    What gets no centre there is tried as a component of its own: parts of a scene that hang together by
    photographs from one place have scales of their own.

    Parameters
    ----------
    min_images : images that such a further component must have.
    """
    parts: list[tuple[AveragedCenters, float]] = []
    for component in range(int(components.max(initial=-1)) + 1):
        mine = components == component
        found = _position_parts(problem, mine, replace(settings, restarts=0), min_images)
        if settings.restarts and found[0][1] < DOUBTFUL_SHARE:
            found = _position_parts(problem, mine, settings, min_images)
        parts += [part for part in found if part[0].placed.any()]
    parts.sort(key=lambda part: -np.count_nonzero(part[0].placed))
    centers, labels = np.full((problem.image_count, 3), np.nan), np.full(problem.image_count, -1, np.int32)
    edge_residuals, rays = np.full(len(problem.pairs), np.nan), [np.zeros(0)]
    for number, (part, _) in enumerate(parts):
        centers[part.placed], labels[part.placed] = part.centers[part.placed], number
        of_part = np.asarray(part.placed[problem.pairs].all(axis=1))
        edge_residuals[of_part] = edge_angles_rad(problem.select_edges(of_part), part.centers)
        rays.append(part.ray_residuals_rad[np.isfinite(part.ray_residuals_rad)])
    agreeing = tuple(share for _, share in parts)
    return PositionedComponents(centers, labels, edge_residuals, np.concatenate(rays), agreeing)


def _position_parts(
    problem: PositioningProblem, mine: Array, settings: PositioningSettings, min_images: int
) -> list[tuple[AveragedCenters, float]]:
    """The largest part of images (N,) bool, then others, each with the share of the rays that agree.

    Images that are in no part count against the first one.
    """
    first = average_translations(problem.select_images(mine), settings)
    further = _further_parts(problem, mine & ~first.placed, settings, min_images)
    elsewhere = np.zeros(problem.image_count, dtype=bool)
    for part, _ in further:
        elsewhere |= part.placed
    rays = first.ray_residuals_rad[~elsewhere[first.ray_images]]
    return [(first, _share(rays, settings.limits)), *further]


def _further_parts(
    problem: PositioningProblem, left: Array, settings: PositioningSettings, min_images: int
) -> list[tuple[AveragedCenters, float]]:
    """Parts among images (N,) bool that were left out of one: rays alone hold them in place.

    Edges are too little evidence here: these images may as well belong to the model that left them out.
    """
    settings = replace(settings, restarts=0, limits=replace(settings.limits, edge_rad=0.0))
    left = left.copy()
    parts: list[tuple[AveragedCenters, float]] = []
    while True:
        rest = largest_part(problem.select_images(left))
        images = rest.images()
        if len(images) < min_images:
            return parts
        part = average_translations(rest, settings)
        share = _share(part.ray_residuals_rad[part.placed[part.ray_images]], settings.limits)
        if np.count_nonzero(part.placed) >= min_images and share >= DOUBTFUL_SHARE:
            parts.append((part, share))
            left[part.placed] = False
        else:
            left[images] = False


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
                if best >= DOUBTFUL_SHARE:
                    break
                other = settings.restart.position(more, settings.seed + start)
                # cameras that were left out may have scales of their own
                other = np.where(np.isfinite(first), other, np.nan)
                other = _checked_positions(more, other, settings)
                share = agreeing_share(whole, other, limits)
                if share > best:
                    chosen, centers, best = more, other, share
    centers = normalize_gauge(part, centers)
    return AveragedCenters(
        centers=centers,
        ray_residuals_rad=angles_rad(chosen, centers, locate_landmarks(chosen, centers)),
        ray_images=chosen.ray_images,
    )


def agreeing_share(problem: PositioningProblem, centers: Array, limits: SupportLimits) -> float:
    """Share of the rays that pass by their landmarks within the limit of a ray.

    Rays of images without a centre do not; the share of no rays is 1.
    """
    return _share(angles_rad(problem, centers, locate_landmarks(problem, centers)), limits)


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


def _share(angles: Array, limits: SupportLimits) -> float:
    """Share of the rays whose angles (Q) are within the limit; NaN ones are not, and that of none is 1."""
    return float(np.mean(angles < limits.ray_rad)) if len(angles) else 1.0


def _refined(problem: PositioningProblem, centers: Array, settings: PositioningSettings) -> Array:
    start = normalize_gauge(problem, centers)
    return refine_angles(problem, start, settings.limits.sigma_rad)[0]


def _checked(
    problem: PositioningProblem, centers: Array, limits: SupportLimits, attach: bool = True
) -> Array:
    known = np.isfinite(centers[:, 0])
    held = known & held_cameras(problem, centers, locate_landmarks(problem, centers), limits)
    if attach:
        return attach_cameras(problem, centers, held, limits)
    return np.where(held[:, None], centers, np.nan)
