"""What every robust estimator of a relative pose must do."""

from typing import Any, ClassVar

import numpy as np
import pytest

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import angle_between, angle_of, exp_so3
from snakesfm.two_view.estimators import ESTIMATORS, PoseEstimator
from snakesfm.two_view.sampson import Correspondences

FOCAL = 800.0


def correspondences(
    seed: int, count: int, noise_px: float, outliers: int
) -> tuple[Correspondences, Array, Array]:
    """Points seen by two cameras, the last ``outliers`` of them anywhere; the true pose."""
    rng = np.random.default_rng(seed)
    rotation = exp_so3(np.array([0.05, -0.2, 0.03]))
    translation = np.array([0.9, 0.1, 0.2])
    world = rng.uniform([-2, -2, 4], [2, 2, 9], (count, 3))
    local = world @ rotation.T + translation
    rays_i, rays_j = world / world[:, 2:], local / local[:, 2:]
    for rays in (rays_i, rays_j):
        rays[:, :2] += rng.normal(0, noise_px / FOCAL, (count, 2))
    if outliers:
        rays_j[-outliers:, :2] = rng.uniform(-0.5, 0.5, (outliers, 2))
    return (
        Correspondences(rays_i, rays_j, FOCAL, FOCAL),
        rotation,
        translation / np.linalg.norm(translation),
    )


class RelativePoseContract:
    """Inherited once per estimator."""

    name: ClassVar[str]
    max_error_deg: ClassVar[float] = 0.5

    @property
    def estimate(self) -> PoseEstimator:
        return ESTIMATORS[self.name]

    def errors_deg(self, pose: Any, rotation: Array, translation: Array) -> tuple[float, float]:
        return (
            float(np.degrees(angle_of(pose.rotation @ rotation.T))),
            float(np.degrees(angle_between(pose.translation, translation))),
        )

    def test_exact_points_give_the_exact_pose(self) -> None:
        points, rotation, translation = correspondences(1, 200, 0.0, 0)
        pose = self.estimate(points, 1.0, 1000, 0)
        assert pose is not None
        assert max(self.errors_deg(pose, rotation, translation)) < 1e-2
        assert pose.inliers.all()

    def test_outliers_are_found(self) -> None:
        points, rotation, translation = correspondences(2, 400, 0.3, 160)
        pose = self.estimate(points, 1.5, 5000, 0)
        assert pose is not None
        errors = self.errors_deg(pose, rotation, translation)
        assert 1e-5 < max(errors) < self.max_error_deg
        assert pose.inliers[:240].mean() > 0.8
        assert pose.inliers[240:].mean() < 0.1

    def test_result_has_the_promised_form(self) -> None:
        points, _, _ = correspondences(3, 120, 0.3, 30)
        pose = self.estimate(points, 1.5, 1000, 0)
        assert pose is not None
        assert pose.inliers.shape == (120,)
        assert pose.inliers.dtype == bool
        assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
        assert np.linalg.norm(pose.translation) == pytest.approx(1.0)

    @pytest.mark.parametrize("count", [0, 1, 4])
    def test_too_few_points_give_nothing(self, count: int) -> None:
        points, _, _ = correspondences(4, 20, 0.0, 0)
        assert self.estimate(points.take(np.arange(count)), 1.0, 100, 0) is None

    def test_one_point_repeated_does_not_crash(self) -> None:
        points, _, _ = correspondences(5, 20, 0.0, 0)
        pose = self.estimate(points.take(np.zeros(20, dtype=int)), 1.0, 100, 0)
        assert pose is None or np.isfinite(pose.rotation).all()

    def test_same_seed_same_result(self) -> None:
        points, _, _ = correspondences(6, 300, 0.4, 120)
        first, second = (self.estimate(points, 1.0, 2000, 7) for _ in range(2))
        assert first is not None and second is not None
        assert np.array_equal(first.rotation, second.rotation)
        assert np.array_equal(first.inliers, second.inliers)


class TestPoselib(RelativePoseContract):
    name = "poselib"


class TestOpencvGcransac(RelativePoseContract):
    name = "opencv_gcransac"
    max_error_deg = 2.0


class TestPycolmap(RelativePoseContract):
    name = "pycolmap"
    max_error_deg = 1.0
