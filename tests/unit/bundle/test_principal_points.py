"""Principal points are refined where the model tells them, and stay where it does not."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle.interface import SolverSettings
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem

CENTRED = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.05), "estimated")
OFFSET = replace(CENTRED, params=(500.0, 323.0, 244.0, -0.05))
FAR_OFF = replace(CENTRED, params=(500.0, 350.0, 260.0, -0.05))


def refined(camera, noise_px=0.1, points=1000, per_image=False, held=frozenset(), **changes):
    """The adjusted cameras of a scene seen by ``camera``, and the names of the rounds, from a centred start."""
    made = make_problem(12, points, noise_px=noise_px, camera=camera, seed=5)
    cameras = 12 if per_image else 1
    model = replace(true_model(made), cameras=(CENTRED,) * cameras, camera_ids=np.arange(12) % cameras)
    found, records = run_rounds(made, model, SolverSettings(constant_cameras=held), **changes)
    return np.array([camera.params for camera in found.cameras]), [record.name for record in records]


def test_a_well_told_principal_point_is_found():
    params, names = refined(OFFSET)
    assert names[-2:] == ["principal points", "last pass"]
    np.testing.assert_allclose(params[0, 1:3], OFFSET.params[1:3], atol=0.9)
    np.testing.assert_allclose(params[0, 0], 500.0, atol=1.0)
    assert np.linalg.norm(params[0, 1:3] - CENTRED.params[1:3]) > 4.0


@pytest.mark.parametrize(
    "case",
    [
        {"camera": OFFSET, "noise_px": 3.0, "points": 150},
        {"camera": OFFSET, "per_image": True},
        {"camera": OFFSET, "refine_principal_points": False},
        {"camera": OFFSET, "held": frozenset([1])},
        {"camera": OFFSET, "max_principal_point_gap": 1e-6},
        {"camera": CENTRED},
        {"camera": FAR_OFF},
        {"camera": OFFSET, "min_principal_point_offset": 0.01},
    ],
    ids=[
        "noisy",
        "one image each",
        "switched off",
        "held",
        "no gap",
        "centred",
        "not believable",
        "too near",
    ],
)
def test_other_principal_points_stay(case):
    params, names = refined(**case)
    assert "principal points" not in names
    assert np.all(params[:, 1:3] == CENTRED.params[1:3])
