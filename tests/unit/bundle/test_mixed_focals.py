"""Images of several focal lengths that share a camera are found out."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle.interface import SolverSettings
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem

CENTER = np.array([320.0, 240.0])
CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, *CENTER, 0.0), "estimated")


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
