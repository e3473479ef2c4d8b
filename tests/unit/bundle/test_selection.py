"""Large models adjusted by a selection of their points."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle import following, rounds, selection
from snakesfm.bundle.ceres import adjust_ceres
from snakesfm.bundle.following import Views, follow_cameras
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.model import from_reconstruction, to_reconstruction
from snakesfm.bundle.selection import adjust_selection, select_points, with_some_points
from snakesfm.geometry.poses import center_of
from snakesfm.synthetic.problems import make_problem

NAMES = [f"{k}.jpg" for k in range(12)]


def perturbed(noise_px=0.3):
    """The true model, one with moved points and cameras, and the first as pycolmap's."""
    made = make_problem(12, 600, noise_px=noise_px, seed=3)
    model = true_model(made)
    rng = np.random.default_rng(0)
    moved = replace(
        model,
        points=made.points + 0.02 * rng.standard_normal(made.points.shape),
        translations=made.translations + 0.01 * rng.standard_normal(made.translations.shape),
    )
    return model, to_reconstruction(moved, made.keypoints, NAMES)


def test_every_image_keeps_its_observations_up_to_the_number_and_few_more():
    model, _ = perturbed()
    count = len(model.points)
    owners = np.repeat(np.arange(count), np.diff(model.offsets))
    chosen = select_points(owners, model.image_ids, count, 40, 0)
    all_of_image = np.bincount(model.image_ids)
    kept = np.bincount(model.image_ids[chosen[owners]], minlength=len(all_of_image))
    assert (kept >= np.minimum(all_of_image, 40)).all()
    assert chosen.mean() < 0.6
    lengths = np.diff(model.offsets)
    assert lengths[chosen].mean() > lengths[~chosen].mean()


def test_the_number_of_all_observations_chooses_all_points():
    model, _ = perturbed()
    owners = np.repeat(np.arange(len(model.points)), np.diff(model.offsets))
    assert select_points(owners, model.image_ids, len(model.points), 10_000, 0).all()


def test_trials_take_few_points_but_fifteen_for_each_image():
    _, whole = perturbed()
    assert 90 <= with_some_points(whole, 50).num_points3D() <= 15 * 12
    assert 200 <= with_some_points(whole, 400).num_points3D() <= 400
    assert with_some_points(whole, 1000).num_points3D() == whole.num_points3D()


def test_trials_take_fewer_points_where_many_images_see_them(monkeypatch):
    monkeypatch.setattr(selection, "LONG_TRACK", 2)
    _, reconstruction = perturbed()
    trial = with_some_points(reconstruction, 200)
    observations = [trial.image(k).num_points3D for k in trial.reg_image_ids()]
    assert 200 <= sum(observations) <= 400
    # an even share would be 33 at most
    assert min(observations) >= 8
    again = with_some_points(trial, 200)
    assert again.compute_num_observations() == sum(observations)


@pytest.mark.parametrize("per_image", [60, 10_000])
def test_poses_and_all_points_come_out_as_by_adjusting_all(per_image):
    model, whole = perturbed()
    _, part = perturbed()
    solving = SolverSettings(loss_scale_px=1.0, constant_cameras=frozenset({1}))
    adjust_ceres(whole, solving)
    before, after = adjust_selection(part, adjust_ceres, solving, per_image, 0)
    assert after < before
    expected, found = (from_reconstruction(adjusted, model)[0] for adjusted in (whole, part))
    centers = [center_of(m.rotations, m.translations) for m in (expected, found)]
    # the noise of fewer observations is larger
    assert np.abs(centers[0] - centers[1]).max() < (0.02 if per_image == 60 else 1e-4)
    errors = [m.points - model.points for m in (expected, found)]
    spread = [np.median(np.linalg.norm(e - e.mean(axis=0), axis=1)) for e in errors]
    assert spread[1] < (1.5 * spread[0] if per_image == 60 else 1.01 * spread[0])


def test_points_that_were_not_chosen_are_as_if_solved_for_alone():
    _, reconstruction = perturbed(noise_px=0.0)
    adjust_selection(
        reconstruction, adjust_ceres, SolverSettings(loss_scale_px=1.0, function_tolerance=1e-12), 60, 0
    )
    reconstruction.update_point_3d_errors()
    assert max(point.error for point in reconstruction.points3D.values()) < 1e-3


def projected(points, images):
    """What two cameras a unit apart see of points (L,3), each in one of the ``images``, with a little noise."""
    cameras = np.zeros((13, 2))
    cameras[[0, 4, 8]], cameras[9], cameras[12] = 1.0, [0.0, -1.0], 500.0
    in_camera = points.T + cameras[9:12, images]
    rays = in_camera[:2] / in_camera[2] + np.random.default_rng(0).normal(0, 0.3 / 500, (2, len(images)))
    return Views(images, rays, cameras)


@pytest.mark.parametrize("at_once", [2, 7, 1000])
def test_points_follow_to_where_their_loss_is_least_however_many_at_once(monkeypatch, at_once):
    monkeypatch.setattr(following, "OBSERVATIONS_AT_ONCE", at_once)
    true = np.random.default_rng(1).uniform([-1, -1, 4], [1, 1, 6], (20, 3))
    owners, images = np.repeat(np.arange(20), 2), np.tile([0, 1], 20)
    views = projected(true[owners], images)
    start = true + 0.05
    found = follow_cameras(start, owners, views, 2.0)

    def loss(points):
        in_camera = points[owners].T + views.cameras[9:12, images]
        squares = 500.0**2 * ((in_camera[:2] / in_camera[2] - views.rays) ** 2).sum(axis=0)
        return np.add.reduceat(np.log1p(squares / 4.0), np.arange(0, 40, 2))

    assert (loss(found) < 0.1 * loss(start)).all()
    for shift in 0.003 * np.vstack([np.eye(3), -np.eye(3)]):
        assert (loss(found + shift) > loss(found) - 1e-3).all()


def test_a_point_that_no_camera_sees_stays_and_one_seen_once_in_front_follows():
    true = np.array([[0.0, 0.0, 5.0], [0.2, 0.0, 5.0]])
    owners, images = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    views = projected(true[owners], images)
    views.rays[:, 3] = np.nan
    start = np.array([[0.0, 0.0, -5.0], [0.25, 0.05, 5.0]])
    found = follow_cameras(start, owners, views, 2.0)
    assert (found[0] == start[0]).all()
    np.testing.assert_allclose(found[1, :2] / found[1, 2], views.rays[:, 2], atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"select_above_images": 11}, [80, 80, 80]),
        ({"select_above_images": 11, "final_observations": 90}, [80, 80, 80, 90]),
        ({"select_above_images": 11, "early_observations": 0, "final_observations": 90}, [90]),
        ({"select_above_images": 12, "final_observations": 90}, []),
    ],
)
def test_all_passes_but_the_last_have_a_selection_in_large_models(monkeypatch, changes, expected):
    told = []

    def adjust(reconstruction, adjuster, solving, per_image, seed):
        told.append(per_image)
        return adjust_selection(reconstruction, adjuster, solving, per_image, seed)

    monkeypatch.setattr(rounds, "adjust_selection", adjust)
    made = make_problem(12, 600, noise_px=0.3, seed=3)
    model, settings = true_model(made), {"early_observations": 80, "refine_principal_points": False}
    found, records = run_rounds(made, model, **settings | changes)
    assert told == expected
    assert [record.name for record in records] == ["round 1", "round 2", "round 3", "last pass"]
    assert found.registered.all()
