"""How the rounds of bundle adjustment are solved: what they refine, and by which iterations."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle import rounds
from snakesfm.bundle.interface import SolverSettings
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem

TRUE = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.05), "estimated")
START = replace(TRUE, params=(560.0, 320.0, 240.0, 0.0))


@pytest.fixture
def passes(monkeypatch):
    """What every pass of the solver was told, in order."""
    told = []
    adjuster = rounds.bundle_adjuster("ceres")

    def adjust(reconstruction, settings):
        told.append(settings)
        return adjuster(reconstruction, settings)

    monkeypatch.setattr(rounds, "bundle_adjuster", lambda solver: adjust)
    # its trial is no pass
    monkeypatch.setattr(rounds, "find_mixed_focals", lambda *_: {})
    return told


def adjusted(solving=None, **changes):
    """The camera that the rounds find from a wrong focal length without distortion."""
    made = make_problem(12, 600, noise_px=0.2, camera=TRUE, seed=5)
    model = replace(true_model(made), cameras=(START,))
    found, _ = run_rounds(made, model, solving, **{"thresholds_px": (20.0, 5.0, 3.0)} | changes)
    return np.array(found.cameras[0].params)


def test_distortion_is_held_in_the_first_round(passes):
    params = adjusted()
    assert [settings.refine_distortion for settings in passes[:3]] == [False, True, True]
    np.testing.assert_allclose(params[0], 500.0, rtol=0.01)
    np.testing.assert_allclose(params[3], -0.05, atol=0.01)


def test_distortion_is_free_in_a_round_that_is_also_the_last(passes):
    params = adjusted(thresholds_px=(5.0,))
    assert passes[0].refine_distortion
    np.testing.assert_allclose(params[3], -0.05, atol=0.01)


def test_distortion_stays_held_where_it_is_switched_off(passes):
    assert adjusted(SolverSettings(refine_distortion=False))[3] == 0.0
    assert not any(settings.refine_distortion for settings in passes)


def test_a_camera_gone_wild_is_free_again_in_the_next_pass(passes, monkeypatch):
    reset = rounds.reset_wild_cameras
    calls = []

    def once(reconstruction, cameras, before, *limits):
        calls.append(limits)
        limits = (1.01, 1.01, 1.0) if len(calls) == 1 else limits
        return reset(reconstruction, cameras, before, *limits)

    monkeypatch.setattr(rounds, "reset_wild_cameras", once)
    params = adjusted()
    assert [1 in settings.constant_cameras for settings in passes[:4]] == [False, True, False, False]
    np.testing.assert_allclose(params[0], 500.0, rtol=0.01)


def test_a_camera_that_is_always_wild_keeps_its_first_intrinsics():
    np.testing.assert_array_equal(adjusted(max_guessed_focal_change=1.001), START.params)


def bent(model, terms, **changes):
    """The first camera that rounds find from nothing but the true focal length, the truth, and the rounds."""
    true = Camera(model, 640, 480, (500.0, 500.0, 320.0, 240.0, *terms), "estimated")
    made = make_problem(12, 600, noise_px=0.2, camera=true, seed=5)
    start = replace(true, params=true.params[:4] + (0.0,) * len(terms))
    settings = {"refine_principal_points": False} | changes
    found, records = run_rounds(made, replace(true_model(made), cameras=(start,)), **settings)
    return found.cameras[0], true, records


@pytest.mark.parametrize(
    ("model", "terms"),
    [
        ("OPENCV", (-0.2, 1.5, 0.0, 0.0)),
        ("FULL_OPENCV", (-0.116, 1.038, 0.002, -0.003, -1.547, 0.127, 0.835, -1.66)),
        ("OPENCV_FISHEYE", (0.1, -0.08, 1.76, -1.88)),
    ],
)
def test_large_terms_that_make_up_for_each_other_are_no_wild_distortion(model, terms):
    found, true, records = bent(model, terms)
    assert not any(record.wild for record in records)
    radii = np.linspace(0.05, 0.45, 9)
    rays = np.column_stack([radii, 0.5 * radii, np.ones(9)])
    assert (
        np.abs(found.to_pycolmap().img_from_cam(rays) - true.to_pycolmap().img_from_cam(rays)).max() < 1.0
    )


def test_rounds_tell_of_cameras_that_were_reset_and_held():
    found, true, records = bent("OPENCV", (-0.2, 0.1, 0.0, 0.0), max_distortion=0.05)
    assert found.params[4:] == (0.0,) * 4
    assert abs(found.params[0] / true.params[0] - 1) < 0.1
    # the fourth may be followed by one with one focal length
    assert [dict(record.wild) for record in records[:4]] == [{}, *[{1: "distortion"}] * 3]
    assert records[-1].held == {1: "distortion"}


def test_final_passes_iterate_within_their_steps_and_only_the_last_is_solved_to_the_end(passes):
    found = adjusted(refine_principal_points=False)
    assert [told.inner_iterations for told in passes] == [False, False, True, True]
    assert [told.loss for told in passes] == ["cauchy", "cauchy", "cauchy", "huber"]
    tolerances = [told.function_tolerance for told in passes]
    assert tolerances == [300 * tolerances[-1]] * 3 + [SolverSettings().function_tolerance]
    assert abs(found[0] - TRUE.params[0]) < 5.0


@pytest.mark.parametrize(("sigmas", "fewest", "most"), [(12.0, 0, 2), (1000.0, 25, 40)])
def test_only_observations_within_the_noise_take_part_in_the_last_pass(monkeypatch, sigmas, fewest, most):
    made = make_problem(12, 600, noise_px=0.05, camera=TRUE, seed=5)
    wrong = np.random.default_rng(0).choice(len(made.keypoints[3]), 40, replace=False)
    made.keypoints[3][wrong] += 2.0
    seen = []
    adjuster = rounds.bundle_adjuster("ceres")

    def adjust(reconstruction, settings):
        if settings.loss == "huber":
            seen.append(sum(reconstruction.image(4).points2D[k].has_point3D() for k in wrong.tolist()))
        return adjuster(reconstruction, settings)

    monkeypatch.setattr(rounds, "bundle_adjuster", lambda solver: adjust)
    settings = {"outlier_sigmas": sigmas, "complete_tracks": False, "refine_principal_points": False}
    run_rounds(made, true_model(made), **settings)
    assert len(seen) == 1 and fewest <= seen[0] <= most


@pytest.mark.parametrize(
    ("patient", "cheap", "expected"), [(False, 100_000, 50), (True, 0, 50), (True, 10**9, 500)]
)
def test_small_models_may_take_more_steps(patient, cheap, expected, passes, monkeypatch) -> None:
    monkeypatch.setattr(rounds, "CHEAP_STEPS", cheap)
    made = make_problem(8, 300, noise_px=0.3, seed=2)
    settings = {"patient": patient, "refine_principal_points": False}
    run_rounds(made, true_model(made), SolverSettings(max_iterations=50), **settings)
    assert [told.max_iterations for told in passes] == [expected] * 4
