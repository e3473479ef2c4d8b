"""Positions and viewing directions of cameras; neighbouring cameras are about one unit apart."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import exp_so3


@dataclass(frozen=True)
class Scene:
    """Cameras and points on surfaces: cam_from_world rotations (N,3,3), the rest (.,3), world with z up."""

    rotations: Array
    centers: Array
    points: Array
    normals: Array


def look_at(centers: Array, targets: Array, up: Array) -> Array:
    """cam_from_world rotations (N,3,3) of cameras that look at ``targets``, image top towards ``up``."""
    forward = targets - centers
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def wobble(rotations: Array, angle_deg: float, rng: np.random.Generator) -> Array:
    """Rotations (N,3,3) turned by Gaussian angles about each axis, as those of a hand-held camera are."""
    return np.asarray(exp_so3(rng.normal(0.0, np.radians(angle_deg), (len(rotations), 3))) @ rotations)


def ring(camera_count: int, point_count: int, rng: np.random.Generator) -> Scene:
    """Cameras on a circle look inwards at a bumpy ball."""
    radius = max(camera_count / (2.0 * np.pi), 3.0)
    angle = 2.0 * np.pi * np.arange(camera_count) / camera_count
    centers = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(camera_count)], axis=1)
    centers += rng.normal(0.0, 0.1, centers.shape)
    normals = rng.normal(0.0, 1.0, (point_count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * (0.4 * radius * rng.uniform(0.7, 1.1, (point_count, 1)))
    rotations = look_at(centers, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Scene(wobble(rotations, 3.0, rng), centers, points, normals)


def street(camera_count: int, point_count: int, rng: np.random.Generator) -> Scene:
    """A car drives along x between two rows of houses and looks ahead."""
    length = float(camera_count)
    x = np.arange(camera_count, dtype=np.float64)
    centers = np.stack([x, np.zeros(camera_count), np.full(camera_count, 1.5)], axis=1)
    centers += rng.normal(0.0, [0.1, 0.1, 0.03], centers.shape)
    side = rng.choice([-1.0, 1.0], point_count)
    wall = np.stack(
        [
            rng.uniform(0.0, length + 12.0, point_count),
            side * (4.0 + rng.uniform(-0.7, 0.7, point_count)),
            rng.uniform(0.0, 6.0, point_count),
        ],
        axis=1,
    )
    facing = np.stack([-np.ones(point_count) * 0.6, -side, np.zeros(point_count)], axis=1)
    on_road = rng.random(point_count) < 0.2
    points = np.where(on_road[:, None], wall * [1.0, 0.7, 0.0], wall)
    normals = np.where(
        on_road[:, None], [0.0, 0.0, 1.0], facing / np.linalg.norm(facing, axis=1, keepdims=True)
    )
    rotations = look_at(centers, centers + np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    return Scene(wobble(rotations, 4.0, rng), centers, points, normals)


def area(camera_count: int, point_count: int, rng: np.random.Generator) -> Scene:
    """Aerial photographs on a grid look down at hilly ground, each turned at random."""
    columns = int(np.ceil(np.sqrt(camera_count)))
    cell = np.arange(camera_count)
    ground = np.stack([cell % columns, cell // columns], axis=1) + rng.normal(0.0, 0.15, (camera_count, 2))
    centers = np.concatenate([ground, 3.0 + rng.normal(0.0, 0.2, (camera_count, 1))], axis=1)
    low, high = ground.min(axis=0) - 1.0, ground.max(axis=0) + 1.0
    spots = rng.uniform(low, high, (point_count, 2))
    height = 0.4 * np.sin(1.7 * spots[:, 0]) * np.cos(1.3 * spots[:, 1]) + rng.uniform(
        0.0, 0.5, point_count
    )
    points = np.concatenate([spots, height[:, None]], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (point_count, 1))
    heading = rng.uniform(0.0, 2.0 * np.pi, camera_count)
    up = np.stack([np.cos(heading), np.sin(heading), np.zeros(camera_count)], axis=1)
    rotations = look_at(centers, centers - np.array([0.0, 0.0, 1.0]), up)
    return Scene(wobble(rotations, 8.0, rng), centers, points, normals)


def facade(camera_count: int, point_count: int, rng: np.random.Generator) -> Scene:
    """A walker passes a wall with relief and photographs it, more or less straight on."""
    x = np.arange(camera_count, dtype=np.float64)
    centers = np.stack([x, np.full(camera_count, -5.0), np.full(camera_count, 1.5)], axis=1)
    centers += rng.normal(0.0, [0.2, 0.5, 0.1], centers.shape)
    points = np.stack(
        [
            rng.uniform(-3.0, camera_count + 2.0, point_count),
            rng.uniform(-0.8, 0.4, point_count),
            rng.uniform(0.0, 4.0, point_count),
        ],
        axis=1,
    )
    normals = np.tile([0.0, -1.0, 0.0], (point_count, 1))
    rotations = look_at(centers, centers + np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    return Scene(wobble(rotations, 7.0, rng), centers, points, normals)


LAYOUTS: dict[str, Callable[[int, int, np.random.Generator], Scene]] = {
    "ring": ring,
    "street": street,
    "area": area,
    "facade": facade,
}
