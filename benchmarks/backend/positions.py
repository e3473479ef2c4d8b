"""What positions cameras, given their rotations: snakesfm's averagers, and pycolmap's as it comes."""

from collections.abc import Callable

import numpy as np

from benchmarks.backend.problems import Problem
from snakesfm.arrays import Array
from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.rotation_averaging.base import edge_residuals
from snakesfm.rotation_averaging.rejection import residual_limit
from snakesfm.stages.average_translations import positioning_settings, translation_averager
from snakesfm.translation_averaging.average import average_translations
from snakesfm.translation_averaging.averagers import GlobalPositioning, with_rays
from snakesfm.translation_averaging.problem import (
    PositioningProblem,
    direction_sigmas,
    edge_directions,
    world_rays,
)

COLMAP_LOSS_SCALE = 0.1
COLMAP_MIN_VIEWS = 3
# whether restarts help is no question here
CHAIN = AverageTranslationsOptions(method="scale_chain", restarts=0)
RECOVERY = AverageTranslationsOptions(method="translation_recovery")


def pose_positioning(problem: Problem, averaged: Array) -> PositioningProblem:
    """Directions and rays in the world of rotations (N,3,3), as stage average_translations takes them.

    Edges that contradict the rotations are left out by the rule of average_rotations, whoever averaged.
    """
    residuals = np.degrees(edge_residuals(problem.pairs, problem.rotations, averaged))
    fits = residuals <= residual_limit(residuals, 5.0, 10.0)
    pairs = problem.pairs[fits]
    turned = np.isfinite(averaged[problem.ray_images, 0, 0])
    images = problem.ray_images[turned]
    return PositioningProblem(
        image_count=len(problem.truth),
        pairs=pairs,
        directions=edge_directions(averaged, pairs, problem.translations[fits]),
        sigmas_rad=direction_sigmas(problem.covariances[fits]),
        ray_images=images,
        ray_tracks=problem.ray_tracks[turned],
        rays=world_rays(averaged, images, problem.rays[turned]),
    )


def chain_refined(problem: PositioningProblem, seed: int) -> Array:
    """What stage average_translations does with its defaults."""
    return average_translations(problem, positioning_settings(CHAIN, seed)).centers


def position_as_colmap(problem: PositioningProblem, seed: int) -> Array:
    """Pycolmap's global positioning with its default options: from random places, all longer tracks."""
    views = np.bincount(problem.ray_tracks)
    long = problem.select_rays(views[problem.ray_tracks] >= COLMAP_MIN_VIEWS)
    return GlobalPositioning(COLMAP_LOSS_SCALE).position(long, seed)


def first_positions(problem: PositioningProblem, options: AverageTranslationsOptions, seed: int) -> Array:
    """What the options' averager gives, which stage average_translations then refines and checks."""
    return translation_averager(options).position(with_rays(problem, options.rays_per_camera), seed)


POSITIONS: dict[str, Callable[[PositioningProblem, int], Array]] = {
    "scale_chain": chain_refined,
    "scale_chain, not refined": lambda problem, seed: first_positions(problem, CHAIN, seed),
    "translation_recovery": lambda problem, seed: first_positions(problem, RECOVERY, seed),
    "global_positioning": position_as_colmap,
}
"""snakesfm's default is ``scale_chain``, the paper's ``translation_recovery``, GLOMAP's the last."""
