"""Images of several focal lengths that share a camera are found out."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle.interface import SolverSettings, bundle_adjuster
from snakesfm.bundle.mixed_focals import find_mixed_focals
from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import SyntheticProblem, make_problem

CENTER = np.array([320.0, 240.0])
CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, *CENTER, 0.0), "estimated")


def model_of(count: int, camera: Camera, longest: int) -> tuple[SyntheticProblem, BundleModel]:
    """A scene of one camera and its true model, of whose tracks so many images are left at most."""
    made = make_problem(count, 40 * count, layout="ring", noise_px=0.5, camera=camera, seed=3)
    true = replace(true_model(made), cameras=(camera,))
    lengths = np.diff(true.offsets)
    kept = np.arange(true.offsets[-1]) - np.repeat(true.offsets[:-1], lengths) < longest
    offsets = np.r_[0, np.cumsum(np.minimum(lengths, longest))]
    some = replace(
        true, offsets=offsets, image_ids=true.image_ids[kept], keypoint_ids=true.keypoint_ids[kept]
    )
    return made, some


def told(zoom: float, held: frozenset[int] = frozenset()) -> dict[int, float]:
    """What rounds tell of a camera whose every other image was enlarged about its centre."""
    made = make_problem(14, 600, layout="area", noise_px=0.2, camera=CAMERA, seed=3)
    keypoints = [
        CENTER + (points - CENTER) * (zoom if row % 2 else 1.0) for row, points in enumerate(made.keypoints)
    ]
    made = replace(made, keypoints=keypoints)
    model = replace(true_model(made), cameras=(CAMERA,))
    _, records = run_rounds(
        made, model, SolverSettings(constant_cameras=held), refine_principal_points=False
    )
    return dict(records[-1].mixed)


def test_two_focal_lengths_are_told_with_their_difference() -> None:
    assert told(1.1) == {1: pytest.approx(0.1, abs=0.02)}


@pytest.mark.parametrize("case", [{"zoom": 1.0}, {"zoom": 1.005}, {"zoom": 1.1, "held": frozenset([1])}])
def test_one_focal_length_a_change_by_focusing_and_given_cameras_are_left_alone(case) -> None:
    assert told(**case) == {}


def test_few_points_and_a_lens_of_many_parameters_are_no_sign_of_several_focal_lengths() -> None:
    camera = Camera("FULL_OPENCV", 640, 480, (500.0, 500.0, *CENTER, *[0.0] * 8), "estimated")
    made, model = model_of(200, camera, 3)
    reconstruction = to_reconstruction(model, made.keypoints, [str(row) for row in range(200)])
    adjust = bundle_adjuster("ceres")
    solving = SolverSettings(loss_scale_px=1.75)
    adjust(reconstruction, solving)
    assert find_mixed_focals(reconstruction, adjust, solving) == {}


def test_a_point_behind_a_camera_hides_no_difference() -> None:
    made = make_problem(14, 600, layout="area", noise_px=0.2, camera=CAMERA, seed=3)
    keypoints = [
        CENTER + (points - CENTER) * (1.1 if row % 2 else 1.0) for row, points in enumerate(made.keypoints)
    ]
    model = replace(true_model(made), cameras=(CAMERA,))
    reconstruction = to_reconstruction(model, keypoints, [str(row) for row in range(14)])
    adjuster = bundle_adjuster("ceres")

    def adjust(trial: pycolmap.Reconstruction, solving: SolverSettings) -> tuple[float, float]:
        costs = adjuster(trial, solving)
        point = trial.point3D(min(trial.point3D_ids()))
        seen_by = trial.image(point.track.elements[0].image_id)
        # the camera's centre less its direction
        point.xyz = seen_by.projection_center() - seen_by.viewing_direction()
        return costs

    found = find_mixed_focals(reconstruction, adjust, SolverSettings(loss_scale_px=0.7))
    assert found == {1: pytest.approx(0.1, abs=0.02)}
