"""Synthetic cameras as the input of translation averaging, and how far centres are off."""

import numpy as np

from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.stages.average_translations import positioning_settings
from snakesfm.translation_averaging.averagers import with_rays
from snakesfm.translation_averaging.problem import PositioningProblem, edge_directions, world_rays


def settings(**options):
    """What the options' defaults with changes say, and no restarts if not told."""
    return positioning_settings(AverageTranslationsOptions(**{"restarts": 0} | options), 0)


def averager(method, **options):
    return settings(method=method, **options).averager


SETTINGS = settings()
LIMITS = SETTINGS.limits
CHAIN = SETTINGS.averager


def positioning(truth, rotations=None):
    rotations = truth.rotations if rotations is None else rotations
    lengths = np.diff(truth.track_offsets)
    images = truth.track_image_ids.astype(np.int64)
    return PositioningProblem(
        truth.image_count,
        truth.pairs.astype(np.int64),
        edge_directions(rotations, truth.pairs, truth.edge_translations),
        np.sqrt(truth.edge_covariances[:, 3, 3]),
        images,
        np.repeat(np.arange(len(lengths)), lengths),
        world_rays(rotations, images, truth.cameras[0].normalize(truth.track_keypoints)),
    )


def thinned(problem):
    """The rays that averagers are given."""
    return with_rays(problem, SETTINGS.rays_per_camera)


def errors(centers, truth):
    known = np.isfinite(centers[:, 0])
    a = centers[known] - np.median(centers[known], axis=0)
    b = truth[known] - np.median(truth[known], axis=0)
    scale = np.sum(a * b) / np.sum(a * a)
    return np.linalg.norm(scale * a - b - np.median(scale * a - b, axis=0), axis=1)
