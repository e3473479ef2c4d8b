"""Large models adjusted by a selection of their points."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pytest
from synthetic_scene import true_model

from snakesfm.bundle.ceres import adjust_ceres
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.model import from_reconstruction, to_reconstruction
from snakesfm.bundle.selection import adjust_selection, select_points
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
