"""What every refinement of a relative pose must do, 'none' among them."""

import numpy as np
import pytest
from contracts.test_relative_pose_estimators import correspondences

from snakesfm.geometry.rotations import angle_between, angle_of
from snakesfm.two_view.refinement import SIGMA_FLOOR_PX, RefinedPose, refine_pose
from snakesfm.two_view.sampson import sampson_errors_px
from snakesfm.two_view.tangents import perturb_pose

REACH_PX = 6.0


def pose_error(rotation, translation, truth):
    """Angles in radians of the rotation and of the direction to the true ones, together."""
    return float(angle_of(rotation @ truth[0].T) + angle_between(translation, truth[1]))


class PoseRefinementContract:
    """Inherit, set ``method``, and ``moves`` where it leaves the pose as it is."""

    method = ""
    moves = True

    def refine(self, points, pose) -> RefinedPose:
        return refine_pose(points, *pose, self.method, REACH_PX, 1.0)

    @pytest.fixture
    def noisy(self):
        """Correspondences with noise and outliers, the true pose and one near it."""
        points, *truth = correspondences(1, 400, 0.3, 80)
        return points, truth, perturb_pose(*truth, np.full(5, 0.003))

    def test_result_has_the_promised_form(self, noisy):
        points, _, start = noisy
        found = self.refine(points, start)
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        assert np.linalg.norm(found.translation) == pytest.approx(1.0)
        assert found.covariance.shape == (5, 5)
        np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-6, atol=1e-15)
        assert (np.linalg.eigvalsh(found.covariance) > 0).all()

    def test_errors_are_those_of_the_pose_that_is_returned(self, noisy):
        points, _, start = noisy
        found = self.refine(points, start)
        expected = sampson_errors_px(points, found.rotation, found.translation)
        np.testing.assert_allclose(found.errors_px, expected, atol=1e-9)

    def test_a_pose_nearby_moves_to_the_true_one_or_stays(self, noisy):
        points, truth, start = noisy
        found = self.refine(points, start)
        if self.moves:
            before = pose_error(*start, truth)
            assert 0 < pose_error(found.rotation, found.translation, truth) < 0.5 * before
        else:
            np.testing.assert_array_equal(found.rotation, start[0])
            np.testing.assert_array_equal(found.translation, start[1])

    def test_the_noise_is_that_of_the_inliers(self, noisy):
        points, truth, _ = noisy
        assert 0.2 < self.refine(points, truth).sigma_px < 0.45

    def test_exact_points_leave_the_exact_pose(self):
        points, *truth = correspondences(2, 200, 0.0, 0)
        found = self.refine(points, truth)
        assert pose_error(found.rotation, found.translation, truth) < 1e-5
        assert found.sigma_px == SIGMA_FLOOR_PX
        np.testing.assert_allclose(found.errors_px, 0.0, atol=1e-2)

    def test_more_noise_makes_the_pose_less_certain(self):
        spreads = []
        for noise_px in (0.2, 0.8):
            points, *truth = correspondences(3, 300, noise_px, 0)
            spreads.append(np.sqrt(np.trace(self.refine(points, truth).covariance)))
        assert 2.0 < spreads[1] / spreads[0] < 8.0

    def test_fewer_points_than_a_pose_needs_leave_it(self, noisy):
        points, _, start = noisy
        found = self.refine(points.take(np.arange(5)), start)
        np.testing.assert_array_equal(found.rotation, start[0])
        np.testing.assert_array_equal(found.translation, start[1])
        assert found.errors_px.shape == (5,)

    def test_is_deterministic(self, noisy):
        points, _, start = noisy
        one, other = self.refine(points, start), self.refine(points, start)
        for name in ("rotation", "translation", "covariance", "errors_px", "sigma_px"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


class TestNone(PoseRefinementContract):
    method = "none"
    moves = False


class TestSampson(PoseRefinementContract):
    method = "sampson"


class TestBundle(PoseRefinementContract):
    method = "bundle"
