"""Principal points are refined where the model tells them, and stay where it does not."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle import principal_points
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.model import to_reconstruction
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem

CENTRED = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.05), "estimated")
OFFSET = replace(CENTRED, params=(500.0, 323.0, 244.0, -0.05))
FAR_OFF = replace(CENTRED, params=(500.0, 400.0, 280.0, -0.05))
FAR_ENOUGH = replace(CENTRED, params=(500.0, 336.0, 240.0, -0.05))


def refined(camera, noise_px=0.1, points=1000, per_image=False, held=frozenset(), **changes):
    """The adjusted cameras of a scene seen by ``camera``, and the records of the rounds, from a centred start."""
    made = make_problem(12, points, noise_px=noise_px, camera=camera, seed=5)
    cameras = 12 if per_image else 1
    model = replace(true_model(made), cameras=(CENTRED,) * cameras, camera_ids=np.arange(12) % cameras)
    found, records = run_rounds(made, model, SolverSettings(constant_cameras=held), **changes)
    return np.array([camera.params for camera in found.cameras]), records


def names_of(records):
    return [record.name for record in records]


def test_a_well_told_principal_point_is_found():
    params, records = refined(OFFSET)
    assert names_of(records)[-3:] == ["round 3", "principal points", "last pass"]
    np.testing.assert_allclose(params[0, 1:3], OFFSET.params[1:3], atol=0.9)
    np.testing.assert_allclose(params[0, 0], 500.0, atol=1.0)
    assert np.linalg.norm(params[0, 1:3] - CENTRED.params[1:3]) > 4.0


@pytest.mark.parametrize("most", [200, 10_000])
def test_halves_are_of_fewer_points_where_many_images_see_them(monkeypatch, most):
    monkeypatch.setattr(principal_points, "OBSERVATIONS_PER_HALF", most)
    made = make_problem(12, 1000, camera=CENTRED, seed=5)
    model = to_reconstruction(true_model(made), made.keypoints, [f"{k}.jpg" for k in range(12)])
    counts = []

    def adjust(half, solving):
        counts.append(half.compute_num_observations())
        return 0.0, 0.0

    principal_points.find_told_cameras(model, adjust, SolverSettings(), 0.003, (0.004, 0.02))
    half = model.compute_num_observations() / 2
    assert len(counts) == 2 and 400 < half < 10_000
    assert all(0.5 * most < count < 1.5 * most if most < half else 0.9 * half < count for count in counts)


def test_one_far_off_is_found_where_the_errors_fall_clearly():
    """As of images that were all cropped alike."""
    params, records = refined(FAR_OFF)
    assert names_of(records)[-3:] == ["principal points", "principal points again", "last pass"]
    np.testing.assert_allclose(params[0], FAR_OFF.params, atol=0.9)
    assert not records[-1].far
    # the model before was bent, so the filters had taken observations, which come back
    before, after = (record.counts[2] for record in records[-3:-1])
    assert before < after


def test_one_far_off_is_refused_and_told_of_where_the_errors_hardly_fall():
    noisy = {"camera": FAR_ENOUGH, "noise_px": 1.0, "points": 4000}
    params, records = refined(**noisy)
    assert "principal points" not in names_of(records)
    assert np.all(params[:, 1:3] == CENTRED.params[1:3])
    assert list(records[-1].far) == [1]
    assert 0.02 < records[-1].far[1] < 0.03
    params, records = refined(**noisy, max_principal_point_offset=0.1)
    assert not records[-1].far
    np.testing.assert_allclose(params[0, 1:3], FAR_ENOUGH.params[1:3], atol=3.0)


@pytest.mark.parametrize(
    "case",
    [
        {"camera": OFFSET, "noise_px": 3.0, "points": 150},
        {"camera": OFFSET, "per_image": True},
        {"camera": OFFSET, "refine_principal_points": False},
        {"camera": OFFSET, "held": frozenset([1])},
        {"camera": OFFSET, "max_principal_point_gap": 1e-6},
        {"camera": CENTRED},
        {"camera": OFFSET, "min_principal_point_offset": 0.01},
    ],
    ids=[
        "noisy",
        "one image each",
        "switched off",
        "held",
        "no gap",
        "centred",
        "too near",
    ],
)
def test_other_principal_points_stay(case):
    params, records = refined(**case)
    assert "principal points" not in names_of(records)
    assert not records[-1].far
    assert np.all(params[:, 1:3] == CENTRED.params[1:3])
