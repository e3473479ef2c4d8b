"""Two synthetic views with exact truth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import exp_so3


@dataclass(frozen=True)
class TwoViews:
    keypoints_i: Array
    keypoints_j: Array
    matches: Array
    camera_i: Camera
    camera_j: Camera
    rotation: Array
    translation: Array


def make_two_views(
    seed: int = 0,
    count: int = 300,
    outliers: int = 60,
    noise_px: float = 0.3,
    scene: str = "box",
    baseline: float = 0.9,
    toward: tuple[float, float, float] = (0.9, 0.15, 0.3),
    focal_j: float = 900.0,
) -> TwoViews:
    """Keypoints of a box, a plane or one with a step, seen by two cameras; outliers come last."""
    rng = np.random.default_rng(seed)
    rotation = exp_so3(np.array([0.04, -0.12, 0.05]))
    direction = np.array(toward) / np.linalg.norm(toward)
    cameras = [Camera("SIMPLE_RADIAL", 1000, 800, (focal, 500.0, 400.0, 0.0)) for focal in (900.0, focal_j)]
    world = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (count, 3))
    if scene in ("plane", "step"):
        world[:, 2] = 6.0 + 0.4 * world[:, 0] - 0.3 * world[:, 1]
    if scene == "step":
        world[: count // 10, 2] -= 1.0
    local = world @ rotation.T + baseline * direction
    keypoints = []
    for points, camera in ((world, cameras[0]), (local, cameras[1])):
        pixels = camera.params[0] * points[:, :2] / points[:, 2:] + np.array(camera.params[1:3])
        keypoints.append(pixels + rng.normal(0, noise_px, pixels.shape))
    if outliers:
        keypoints[1][-outliers:] = rng.uniform(0, [1000, 800], (outliers, 2))
    order = rng.permutation(count)
    inverse = np.argsort(order)
    return TwoViews(
        keypoints[0].astype(np.float32),
        keypoints[1][order].astype(np.float32),
        np.column_stack([np.arange(count), inverse]).astype(np.int32),
        cameras[0],
        cameras[1],
        rotation,
        direction,
    )


@pytest.fixture
def two_views() -> Callable[..., TwoViews]:
    return make_two_views
