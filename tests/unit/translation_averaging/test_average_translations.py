"""Translation averaging as a whole: restarts, cameras that are left out, gauge."""

from dataclasses import replace

import numpy as np
import pytest
from positioned_cameras import LIMITS, SETTINGS, errors, positioning, settings

from snakesfm.geometry.rotations import angle_between
from snakesfm.synthetic.problems import make_problem, perturb_rotations
from snakesfm.translation_averaging.average import (
    DOUBTFUL_SHARE,
    agreeing_share,
    average_translations,
    normalize_gauge,
)
from snakesfm.translation_averaging.averagers import with_rays
from snakesfm.translation_averaging.landmarks import cover_cameras, edge_angles_rad


class Misled:
    """First positions that have nothing to do with the scene."""

    def position(self, problem, seed):
        return np.random.default_rng(seed).normal(size=(problem.image_count, 3))


@pytest.mark.parametrize("restarts", [0, 2])
def test_positions_with_which_few_rays_agree_are_looked_for_again(restarts):
    truth = make_problem(20, 1500, "street", noise_px=0.3, rotation_noise_deg=0.05, seed=2)
    problem = positioning(truth)
    misled = replace(settings(refine=False, restarts=restarts), averager=Misled())
    found = average_translations(problem, misled)
    share = agreeing_share(problem, found.centers, LIMITS)
    size = np.ptp(truth.centers, axis=0).max()
    if restarts:
        assert share > 0.9
        assert np.isfinite(found.centers[:, 0]).sum() >= 19
        assert np.median(errors(found.centers, truth.centers)) < 0.02 * size
    else:
        assert share < DOUBTFUL_SHARE
        known = np.isfinite(found.centers[:, 0]).sum()
        assert known < 15 or np.median(errors(found.centers, truth.centers)) > 0.05 * size


def test_positions_with_which_rays_agree_are_final():
    problem = positioning(make_problem(12, 600, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=3))
    once = average_translations(problem, SETTINGS)
    again = average_translations(problem, settings(restarts=3))
    for name, values in vars(once).items():
        np.testing.assert_array_equal(getattr(again, name), values)


def test_rays_of_images_without_a_centre_do_not_agree():
    truth = make_problem(12, 600, "area", noise_px=0.0, rotation_noise_deg=0.0, seed=3)
    problem = positioning(truth)
    assert agreeing_share(problem, truth.centers, LIMITS) > 0.99
    lost = truth.centers.copy()
    lost[:3] = np.nan
    seen = np.mean(~np.isin(problem.ray_images, [0, 1, 2]))
    assert seen - 0.05 < agreeing_share(problem, lost, LIMITS) <= seen + 1e-12
    assert agreeing_share(problem.select_rays(np.zeros(len(problem.rays), bool)), lost, LIMITS) == 1.0


# about three times what is found
@pytest.mark.parametrize(
    ("layout", "most"), [("ring", 0.025), ("street", 0.07), ("area", 0.018), ("facade", 0.04)]
)
def test_whole_averaging_with_noise_and_outliers(layout, most):
    truth = make_problem(40, 2400, layout, 0.7, 0.1, 0.5, 0.1, seed=1)
    problem = positioning(truth, perturb_rotations(truth.rotations, 0.1, 2))
    result = average_translations(problem, SETTINGS)
    found = errors(result.centers, truth.centers)
    assert np.isfinite(result.centers).all()
    assert 1e-3 < np.median(found) < most
    assert found.max() < 3 * most
    good = edge_angles_rad(problem, result.centers)[~truth.edge_outliers]
    assert np.degrees(np.median(good)) < 3.0
    assert np.degrees(np.median(result.ray_residuals_rad)) < 0.2


def test_weak_camera_is_not_thrown_away():
    truth = make_problem(20, 1200, "area", 0.5, seed=4)
    problem = positioning(truth)
    rng = np.random.default_rng(0)
    mine = np.flatnonzero(problem.ray_images == 7)
    rays = problem.rays.copy()
    wild = rng.normal(size=(len(mine), 3))
    rays[mine] = wild / np.linalg.norm(wild, axis=1, keepdims=True)
    edges = ~(problem.pairs == 7).any(axis=1)
    damaged = replace(problem.select_edges(edges), rays=rays)
    result = average_translations(damaged, SETTINGS)
    assert np.isnan(result.centers[7]).all()
    assert np.isfinite(np.delete(result.centers, 7, axis=0)).all()
    assert errors(result.centers, truth.centers).max() < 0.006


def test_camera_with_a_few_good_rays_is_placed():
    truth = make_problem(20, 1200, "area", 0.3, seed=4)
    problem = positioning(truth)
    mine = np.flatnonzero(problem.ray_images == 7)
    rows = np.ones(len(problem.rays), dtype=bool)
    rows[mine[12:]] = False
    few = problem.select_rays(rows).select_edges(~(problem.pairs == 7).any(axis=1))
    result = average_translations(few, SETTINGS)
    assert np.isfinite(result.centers[7]).all()
    assert errors(result.centers, truth.centers)[7] < 0.005


def test_pairs_alone_position_what_they_determine():
    truth = make_problem(25, 1500, "area", 0.5, 0.0, 0.2, 0.1, seed=6)
    problem = positioning(truth)
    problem = problem.select_rays(np.zeros(len(problem.rays), dtype=bool))
    result = average_translations(problem, SETTINGS)
    assert np.isfinite(result.centers[:, 0]).sum() >= 20
    assert 1e-3 < np.median(errors(result.centers, truth.centers)) < 0.02


def test_two_images_have_a_unit_baseline():
    truth = make_problem(2, 500, "facade", noise_px=0.1, rotation_noise_deg=0.0)
    result = average_translations(positioning(truth), SETTINGS)
    baseline = result.centers[1] - result.centers[0]
    assert abs(np.linalg.norm(baseline) - 1.0) < 1e-12
    assert angle_between(baseline, truth.centers[1] - truth.centers[0]) < 1e-6


def test_three_images():
    truth = make_problem(3, 600, "area", noise_px=0.2, rotation_noise_deg=0.1, seed=8)
    result = average_translations(positioning(truth), SETTINGS)
    assert np.isfinite(result.centers).all()
    assert errors(result.centers, truth.centers).max() < 0.002


def test_nothing_and_the_smaller_of_two_parts_get_no_center():
    truth = make_problem(16, 900, "area", noise_px=0.3, seed=9)
    problem = positioning(truth)
    empty = problem.select_edges(np.zeros(len(problem.pairs), bool)).select_rays(
        np.zeros(len(problem.rays), bool)
    )
    assert np.isnan(average_translations(empty, SETTINGS).centers).all()
    lone = problem.select_edges(~(problem.pairs == 3).any(axis=1)).select_rays(problem.ray_images != 3)
    result = average_translations(lone, SETTINGS)
    assert np.isnan(result.centers[3]).all()
    assert np.isfinite(np.delete(result.centers, 3, axis=0)).all()


def test_gauge_and_frame():
    truth = make_problem(15, 700, "ring", noise_px=0.1)
    problem = positioning(truth)
    result = average_translations(problem, SETTINGS)
    lengths = np.linalg.norm(
        result.centers[problem.pairs[:, 1]] - result.centers[problem.pairs[:, 0]], axis=1
    )
    assert abs(np.median(lengths) - 1.0) < 1e-9
    assert np.abs(np.median(result.centers, axis=0)).max() < 1e-9
    moved = normalize_gauge(problem, 3.0 * result.centers + 5.0)
    assert np.allclose(moved, result.centers)
    assert np.median(edge_angles_rad(problem, result.centers)) < np.radians(2.0)


def test_result_does_not_depend_on_the_order_of_edges():
    truth = make_problem(15, 700, "area", seed=3)
    problem = with_rays(positioning(truth), 50)
    order = np.random.default_rng(0).permutation(len(problem.pairs))
    one = average_translations(problem, SETTINGS).centers
    two = average_translations(problem.select_edges(order), SETTINGS).centers
    assert np.allclose(one, two, atol=1e-6)
    assert np.array_equal(one, average_translations(problem, SETTINGS).centers)


@pytest.mark.parametrize(("method", "tolerance"), [("scale_chain", 0.0), ("global_positioning", 1e-6)])
def test_numbers_of_tracks_cost_nothing_and_change_nothing(method, tolerance):
    problem = positioning(make_problem(12, 500, "area", seed=3))
    # an array of one number per track up to the highest would take terabytes
    high = replace(problem, ray_tracks=problem.ray_tracks * 10**9 + 10**12)
    few, many = (average_translations(one, settings(method=method)) for one in (problem, high))
    np.testing.assert_allclose(many.centers, few.centers, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(many.ray_residuals_rad, few.ray_residuals_rad, rtol=0.0, atol=tolerance)
    assert np.isfinite(few.centers).all() and len(few.ray_residuals_rad) > 500


def test_restarts_have_the_loss_of_global_positioning(monkeypatch):
    problem = positioning(make_problem(12, 600, "area", noise_px=0.3, seed=3))
    told = []

    def position(rays, loss_scale, seed):
        told.append((len(rays.rays), loss_scale, seed))
        return np.zeros((rays.image_count, 3))

    monkeypatch.setattr("snakesfm.translation_averaging.positioning.position_globally", position)
    misled = settings(refine=False, restarts=2, rays_per_camera=20, positioning_loss_scale=0.2)
    average_translations(problem, replace(misled, averager=Misled()))
    many = len(with_rays(problem, 300).rays)
    assert told == [(many, 0.2, 0), (many, 0.2, 1)]


def test_no_start_is_tried_after_one_with_which_most_rays_agree(monkeypatch):
    truth = make_problem(12, 600, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=3)
    problem, told = positioning(truth), []

    def position(rays, loss_scale, seed):
        told.append(seed)
        return truth.centers if len(told) > 1 else np.zeros((rays.image_count, 3))

    monkeypatch.setattr("snakesfm.translation_averaging.positioning.position_globally", position)
    misled = replace(settings(refine=False, restarts=4), averager=Misled())
    centers = average_translations(problem, misled).centers
    assert told == [0, 1]
    assert errors(centers, truth.centers).max() < 0.01


@pytest.mark.parametrize("method", ["scale_chain", "global_positioning"])
def test_tracks_are_chosen_once_and_once_more_for_all_restarts(method, monkeypatch):
    problem = positioning(make_problem(12, 600, "area", noise_px=0.3, seed=3))
    told = []

    def cover(images, tracks, count, rays_per_camera):
        told.append((len(images), rays_per_camera))
        return cover_cameras(images, tracks, count, rays_per_camera)

    monkeypatch.setattr("snakesfm.translation_averaging.averagers.cover_cameras", cover)
    monkeypatch.setattr("snakesfm.translation_averaging.average.DOUBTFUL_SHARE", 1.1)
    average_translations(problem, settings(method=method, refine=False, restarts=2, rays_per_camera=20))
    assert told == [(len(problem.rays), 20), (len(problem.rays), 300)]
