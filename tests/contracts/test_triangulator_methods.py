"""What every triangulator must do."""

from dataclasses import replace

import numpy as np
import pytest

from snakesfm.geometry.camera import undistort
from snakesfm.synthetic.problems import make_problem
from snakesfm.triangulation.interface import TriangulationLimits, TriangulationProblem
from snakesfm.triangulation.tracks import triangulator

LIMITS = TriangulationLimits(max_reprojection_error_px=4.0, min_angle_deg=1.0)


def as_problem(made):
    rays = undistort(made.cameras, made.camera_ids, made.track_image_ids, made.track_keypoints)
    focals = np.full(made.image_count, made.cameras[0].focal_px)
    return TriangulationProblem(
        made.rotations, made.translations, focals, made.track_offsets, made.track_image_ids, rays
    )


def errors_of(points, made):
    found = np.isfinite(points[:, 0])
    return np.linalg.norm(points[found] - made.points[found], axis=1), found


def seen_along_z(centers, points, noise_px=0.0):
    """Points (T,3) that all cameras (N,3) see with a focal length of 1000 px, all looking along z."""
    count, offsets = len(centers), points[:, None] - centers
    rays = offsets[..., :2] / offsets[..., 2:] + np.asarray(noise_px) / 1000.0
    return TriangulationProblem(
        np.tile(np.eye(3), (count, 1, 1)),
        -centers,
        np.full(count, 1000.0),
        np.arange(len(points) + 1) * count,
        np.tile(np.arange(count), len(points)),
        rays.reshape(-1, 2),
    )


class TriangulatorContract:
    """Inherit and set ``method``."""

    method = ""

    @pytest.fixture
    def triangulate(self):
        return triangulator(self.method)

    def test_exact_observations_give_exact_points(self, triangulate):
        made = make_problem(12, 300, noise_px=0.0)
        points, inliers = triangulate(as_problem(made), LIMITS)
        errors, found = errors_of(points, made)
        assert found.mean() > 0.95 and inliers[np.repeat(found, np.diff(made.track_offsets))].all()
        assert np.median(errors) < 1e-4

    def test_noise_gives_errors_of_its_size(self, triangulate):
        made = make_problem(12, 300, noise_px=0.5)
        points, _ = triangulate(as_problem(made), LIMITS)
        errors, found = errors_of(points, made)
        assert found.mean() > 0.9
        assert 1e-4 < np.median(errors) < 0.05

    def test_wrong_observations_are_left_out(self, triangulate):
        made = make_problem(12, 400, noise_px=0.3, outlier_ratio=0.1, max_views=12)
        points, inliers = triangulate(as_problem(made), LIMITS)
        errors, found = errors_of(points, made)
        used = np.repeat(found, np.diff(made.track_offsets))
        right = ~made.track_outliers
        long = np.repeat(np.diff(made.track_offsets) >= 4, np.diff(made.track_offsets))
        assert inliers[used & right & long].mean() > 0.95
        assert inliers[made.track_outliers & long].mean() < 0.08
        assert np.median(errors) < 0.03

    def test_many_wrong_observations_cost_no_right_ones(self, triangulate):
        rng = np.random.default_rng(1)
        centers = np.column_stack([np.linspace(-3, 3, 10), rng.normal(0, 0.3, 10), np.zeros(10)])
        truth = rng.uniform([-3, -2, 8], [3, 2, 14], (300, 3))
        noise = rng.normal(0, 0.5, (300, 10, 2))
        wrong = rng.uniform(size=(300, 10)) < 0.3
        noise[wrong] += rng.uniform(8, 40, (wrong.sum(), 1)) * [1.0, 0.3]
        points, inliers = triangulate(seen_along_z(centers, truth, noise), LIMITS)
        inliers = inliers.reshape(300, 10)
        assert inliers[~wrong].mean() > 0.98 and inliers[wrong].mean() < 0.05
        assert 0.004 < np.median(np.linalg.norm(points - truth, axis=1)) < 0.02

    def test_points_behind_a_camera_are_refused(self, triangulate):
        made = make_problem(12, 100, noise_px=0.0)
        problem = as_problem(made)
        turned = np.diag([1.0, -1.0, -1.0])
        behind = replace(
            problem, rotations=turned @ problem.rotations, translations=problem.translations @ turned
        )
        points, inliers = triangulate(behind, LIMITS)
        assert np.isfinite(points[:, 0]).mean() < 0.2 and inliers.mean() < 0.2

    def test_nearly_parallel_rays_give_no_point(self, triangulate):
        point, centers = np.array([0.2, 0.1, 50.0]), np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
        seen = point - centers
        narrow = TriangulationProblem(
            np.repeat(np.eye(3)[None], 3, axis=0),
            -centers,
            np.full(3, 500.0),
            np.array([0, 3]),
            np.arange(3),
            seen[:, :2] / seen[:, 2:],
        )
        points, inliers = triangulate(narrow, LIMITS)
        assert np.isnan(points).all() and not inliers.any()
        points, inliers = triangulate(narrow, replace(LIMITS, min_angle_deg=0.1))
        np.testing.assert_allclose(points[0], point, atol=1e-3)
        assert inliers.all()

    @pytest.mark.parametrize(("factor", "found"), [(0.9, False), (1.1, True)])
    def test_rays_must_meet_at_the_smallest_angle(self, triangulate, factor, found):
        reach = 10.0 * np.tan(np.radians(factor * 2.0) / 2)
        centers = np.array([[-reach, 0.0, 0.0], [reach, 0.0, 0.0]])
        problem = seen_along_z(centers, np.array([[0.0, 0.0, 10.0]]))
        points, inliers = triangulate(problem, replace(LIMITS, min_angle_deg=2.0))
        assert np.isfinite(points).all() == found and (inliers == found).all()

    def test_a_camera_that_looks_away_does_not_agree(self, triangulate):
        centers = np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 20.0]])
        points, inliers = triangulate(seen_along_z(centers, np.array([[0.0, 0.0, 10.0]])), LIMITS)
        np.testing.assert_allclose(points, [[0.0, 0.0, 10.0]], atol=1e-6)
        assert inliers.tolist() == [True, True, False]

    def test_empty_and_single_observations(self, triangulate):
        made = as_problem(make_problem(5, 60))
        empty = replace(
            made, offsets=np.zeros(1, np.int64), image_ids=made.image_ids[:0], rays=made.rays[:0]
        )
        points, inliers = triangulate(empty, LIMITS)
        assert points.shape == (0, 3) and inliers.shape == (0,)
        single = replace(
            made, offsets=np.array([0, 0, 1]), image_ids=made.image_ids[:1], rays=made.rays[:1]
        )
        points, inliers = triangulate(single, LIMITS)
        assert np.isnan(points).all() and not inliers.any()

    def test_deterministic_and_independent_of_other_tracks(self, triangulate):
        made = as_problem(make_problem(12, 200, outlier_ratio=0.1))
        points, inliers = triangulate(made, LIMITS)
        again, same = triangulate(made, LIMITS)
        np.testing.assert_array_equal(points, again)
        np.testing.assert_array_equal(inliers, same)
        half = len(made.offsets) // 2
        end = made.offsets[half]
        part = replace(
            made,
            offsets=made.offsets[: half + 1],
            image_ids=made.image_ids[:end],
            rays=made.rays[:end],
        )
        np.testing.assert_allclose(triangulate(part, LIMITS)[0], points[:half], atol=1e-9)


class TestRansacDlt(TriangulatorContract):
    method = "ransac_dlt"

    def test_hypotheses_are_limited(self, triangulate):
        made = make_problem(30, 100, noise_px=0.3, max_views=25, outlier_ratio=0.1)
        points, _ = triangulate(as_problem(made), replace(LIMITS, max_hypotheses=5))
        errors, found = errors_of(points, made)
        assert found.mean() > 0.7 and np.median(errors) < 0.1


class TestPycolmap(TriangulatorContract):
    method = "pycolmap"
