"""What every solver of bundle adjustment must do."""

import numpy as np
import pytest

from snakesfm.bundle.interface import SolverSettings, bundle_adjuster
from snakesfm.bundle.model import BundleModel, from_reconstruction, reprojection_errors, to_reconstruction
from snakesfm.errors import ConfigError
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.poses import translation_of
from snakesfm.geometry.rotations import angle_of
from snakesfm.synthetic.problems import make_problem, perturb_rotations

RADIAL = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.05), "estimated")
PINHOLE = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))


def scene(noise_px=0.0, camera=RADIAL, outlier_ratio=0.0, start=None):
    """A problem and its model with perturbed poses and points, seen by the camera ``start``."""
    made = make_problem(12, 300, noise_px=noise_px, camera=camera, outlier_ratio=outlier_ratio, seed=4)
    rng = np.random.default_rng(1)
    rotations = perturb_rotations(made.rotations, 0.3, seed=1)
    centers = made.centers + rng.normal(0, 0.02, made.centers.shape)
    model = BundleModel(
        (start or camera,),
        made.camera_ids,
        rotations,
        translation_of(rotations, centers),
        made.points + rng.normal(0, 0.02, made.points.shape),
        made.track_offsets,
        made.track_image_ids,
        made.track_keypoint_ids,
    )
    return made, model, to_reconstruction(model, made.keypoints, [f"{k}.jpg" for k in range(12)])


def relative_rotation_error_deg(result, made):
    found = result.rotations @ result.rotations[0].T
    true = made.rotations @ made.rotations[0].T
    return np.degrees(angle_of(np.einsum("nij,nkj->nik", found, true))[1:])


def errors_px(result, made):
    base = np.r_[0, np.cumsum([len(k) for k in made.keypoints])]
    keypoints = np.concatenate(made.keypoints)[base[result.image_ids] + result.keypoint_ids]
    return reprojection_errors(result, keypoints)


class BundleAdjusterContract:
    """Inherit and set ``solver``."""

    solver = ""

    @pytest.fixture
    def adjust(self):
        return bundle_adjuster(self.solver)

    def test_exact_observations_are_met(self, adjust):
        made, model, reconstruction = scene()
        before, after = adjust(
            reconstruction, SolverSettings(constant_cameras=frozenset([1]), function_tolerance=1e-12)
        )
        result, _ = from_reconstruction(reconstruction, model)
        assert after < 1e-3 < before
        assert errors_px(result, made).max() < 0.02
        assert relative_rotation_error_deg(result, made).max() < 0.01
        assert result.cameras == model.cameras

    def test_noise_leaves_errors_of_its_size(self, adjust):
        made, model, reconstruction = scene(noise_px=0.5)
        adjust(reconstruction, SolverSettings(constant_cameras=frozenset([1])))
        result, _ = from_reconstruction(reconstruction, model)
        assert 0.3 < errors_px(result, made).mean() < 0.7
        assert 1e-3 < relative_rotation_error_deg(result, made).mean() < 0.4

    @pytest.mark.parametrize("loss", ["huber", "cauchy"])
    def test_robust_loss_withstands_wrong_observations(self, adjust, loss):
        means = {}
        for kind in (loss, "squared"):
            made, model, reconstruction = scene(noise_px=0.3, outlier_ratio=0.04)
            adjust(reconstruction, SolverSettings(loss=kind, constant_cameras=frozenset([1])))
            result, _ = from_reconstruction(reconstruction, model)
            means[kind] = relative_rotation_error_deg(result, made).mean()
        assert 1e-3 < means[loss] < 0.5 and means[loss] < 0.5 * means["squared"]

    @pytest.mark.parametrize(
        ("camera", "start"),
        [
            (RADIAL, Camera("SIMPLE_RADIAL", 640, 480, (520.0, 320.0, 240.0, 0.0))),
            (
                Camera("PINHOLE", 640, 480, (500.0, 490.0, 320.0, 240.0)),
                Camera("PINHOLE", 640, 480, (520.0, 510.0, 320.0, 240.0)),
            ),
            (
                Camera("OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, -0.05, 0.02, 0.001, -0.001)),
                Camera("OPENCV", 640, 480, (515.0, 515.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)),
            ),
        ],
    )
    def test_intrinsics_are_refined_with_the_principal_point_held(self, adjust, camera, start):
        made, model, reconstruction = scene(camera=camera, start=start)
        adjust(reconstruction, SolverSettings(function_tolerance=1e-10))
        result, _ = from_reconstruction(reconstruction, model)
        np.testing.assert_allclose(result.cameras[0].params, camera.params, rtol=2e-3, atol=2e-3)
        assert errors_px(result, made).mean() < 0.05

    def test_held_distortion_stays(self, adjust):
        start = Camera("SIMPLE_RADIAL", 640, 480, (510.0, 320.0, 240.0, 0.0))
        _, model, reconstruction = scene(start=start)
        adjust(reconstruction, SolverSettings(refine_distortion=False))
        (camera,) = from_reconstruction(reconstruction, model)[0].cameras
        assert abs(camera.params[3]) < 1e-4
        assert 1.0 < abs(camera.params[0] - 510.0) < 50.0

    def test_held_focal_length_stays(self, adjust):
        start = Camera("SIMPLE_RADIAL", 640, 480, (510.0, 320.0, 240.0, 0.0))
        _, model, reconstruction = scene(start=start)
        adjust(reconstruction, SolverSettings(refine_focal=False))
        (camera,) = from_reconstruction(reconstruction, model)[0].cameras
        assert abs(camera.params[0] - 510.0) < 0.1
        assert 0.01 < abs(camera.params[3]) < 0.2

    def test_one_image_or_no_point_is_left_alone(self, adjust):
        made, model, _ = scene()
        alone = to_reconstruction(
            BundleModel(
                model.cameras,
                model.camera_ids,
                np.where(np.arange(12)[:, None, None] == 0, model.rotations, np.nan),
                model.translations,
                model.points[:0],
                model.offsets[:1],
                model.image_ids[:0],
                model.keypoint_ids[:0],
            ),
            made.keypoints,
            [f"{k}.jpg" for k in range(12)],
        )
        assert adjust(alone, SolverSettings()) == (0.0, 0.0)

    def test_deterministic(self, adjust):
        results = []
        for _ in range(2):
            _, model, reconstruction = scene(noise_px=0.5)
            adjust(reconstruction, SolverSettings())
            results.append(from_reconstruction(reconstruction, model)[0])
        np.testing.assert_array_equal(results[0].rotations, results[1].rotations)
        np.testing.assert_array_equal(results[0].points, results[1].points)


class TestCeres(BundleAdjusterContract):
    solver = "ceres"


class TestGtsam(BundleAdjusterContract):
    solver = "gtsam"

    def test_reaches_the_cost_of_ceres(self, adjust):
        costs = []
        for solve in (adjust, bundle_adjuster("ceres")):
            _, _, reconstruction = scene(noise_px=0.5, camera=PINHOLE)
            settings = SolverSettings(constant_cameras=frozenset([1]), function_tolerance=1e-9)
            costs.append(solve(reconstruction, settings))
        np.testing.assert_allclose(costs[0], costs[1], rtol=1e-3)

    def test_names_a_camera_model_it_lacks(self, adjust):
        fisheye = Camera("OPENCV_FISHEYE", 640, 480, (500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
        _, _, reconstruction = scene(camera=fisheye)
        with pytest.raises(ConfigError, match=r"OPENCV_FISHEYE.*solver"):
            adjust(reconstruction, SolverSettings())
