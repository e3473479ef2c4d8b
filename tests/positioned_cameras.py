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


def two_rooms(first, second, seed=1):
    """A walk through a room, a turn on the spot by 6 images, and a walk through another: centres, problem.

    Nothing tells how large the second room is beside the first. Images on one spot have no direction.
    """
    rng = np.random.default_rng(seed)
    steps = 0.2 * np.r_[np.arange(-first, 0), np.zeros(6), np.arange(1, second + 1)]
    angles = np.radians(np.r_[np.full(first, 90), 90 - 30 * np.arange(1, 7), np.full(second, -90)])
    centers = np.stack([steps, 0 * steps, 0 * steps], axis=1)
    ahead = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    boxes = [([-8, 3, -2], [4, 6, 2]), ([-4, -6, -2], [7, -3, 2]), ([3, -3, -2], [6, 3, 2])]
    points = np.concatenate([rng.uniform(*box, (450, 3)) for box in boxes])
    rays = points[:, None] - centers
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    seen = np.einsum("pni,ni->pn", rays, ahead) > np.cos(np.radians(30))
    tracks, images = np.nonzero(seen)
    shared = np.einsum("pi,pj->ij", seen.astype(int), seen) >= 15
    near = np.triu(shared, 1) & (np.subtract.outer(np.arange(len(steps)), np.arange(len(steps))) >= -6)
    pairs = np.argwhere(near & (np.subtract.outer(steps, steps) != 0))
    directions = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions, rays = directions + rng.normal(size=directions.shape) * 5e-3, rays[tracks, images]
    rays = rays + rng.normal(size=rays.shape) * 5e-4
    return centers, PositioningProblem(
        len(steps),
        pairs,
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        np.full(len(pairs), 5e-3),
        images,
        tracks,
        rays / np.linalg.norm(rays, axis=1, keepdims=True),
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
