"""Parts of a scene whose relative size nothing tells, and what is no part of its own."""

from dataclasses import replace

import numpy as np
import pytest
from positioned_cameras import (
    CHAIN,
    LIMITS,
    SETTINGS,
    averager,
    errors,
    positioning,
    settings,
    thinned,
    two_rooms,
)

from snakesfm.synthetic.problems import make_problem
from snakesfm.translation_averaging.average import DOUBTFUL_SHARE, position_components
from snakesfm.translation_averaging.landmarks import locate_landmarks
from snakesfm.translation_averaging.support import attach_cameras


def one_component(problem, chosen=SETTINGS, least=5):
    return position_components(problem, np.zeros(problem.image_count, int), chosen, least)


@pytest.mark.parametrize(("first", "second"), [(15, 15), (24, 15), (12, 20)])
@pytest.mark.parametrize("restarts", [0, 2])
def test_rooms_joined_by_a_turn_on_the_spot_are_components_of_one_scale_each(first, second, restarts):
    truth, problem = two_rooms(first, second)
    found = one_component(problem, settings(restarts=restarts))
    rooms = np.r_[np.zeros(first, int), np.full(6, -1), np.ones(second, int)]
    assert set(np.unique(found.components)) <= {-1, 0, 1}
    assert np.count_nonzero(found.components == 0) >= np.count_nonzero(found.components == 1)
    for room in (0, 1):
        (number,) = np.unique(found.components[rooms == room])
        mine = found.components == number
        assert errors(found.centers[mine], truth[mine]).max() < 0.03
        assert found.agreeing[number] > 0.9
    between = found.components[problem.pairs[:, 0]] != found.components[problem.pairs[:, 1]]
    assert np.isnan(found.edge_residuals_rad[between]).all()
    assert np.degrees(np.nanmedian(found.edge_residuals_rad)) < 1.0


@pytest.mark.parametrize("method", ["scale_chain", "translation_recovery"])
def test_directions_alone_give_no_part_a_scale(method):
    problem = thinned(two_rooms(15, 14)[1])
    assert CHAIN.link(problem)[0] is None
    centers = averager(method).position(problem, 0)
    placed = np.isfinite(centers[:, 0])
    assert placed[:15].all() != placed[21:].all() and 14 <= placed.sum() <= 21


def test_a_part_needs_enough_images():
    _, problem = two_rooms(24, 15)
    few, enough = (one_component(problem, least=least).components.max() for least in (22, 15))
    assert (few, enough) == (0, 1)


@pytest.mark.parametrize("left", ["wild rays", "edges alone"])
def test_images_that_are_left_are_no_component_without_rays_that_agree(left):
    truth = make_problem(26, 2000, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=4)
    problem = positioning(truth)
    odd = np.arange(26) >= 18
    across = odd[problem.pairs].any(axis=1) & ~odd[problem.pairs].all(axis=1)
    problem = problem.select_edges(~across)
    if left == "wild rays":
        rays, mine = problem.rays.copy(), odd[problem.ray_images]
        rays[mine] = np.random.default_rng(0).normal(size=(mine.sum(), 3))
        problem = replace(problem, rays=rays / np.linalg.norm(rays, axis=1, keepdims=True))
    else:
        problem = problem.select_rays(~odd[problem.ray_images])
    found = one_component(problem)
    np.testing.assert_array_equal(found.components, np.where(odd, -1, 0))


def test_each_component_has_a_share_of_its_own_and_images_left_out_count_against_it():
    problem = positioning(make_problem(40, 3000, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=4))
    components = np.arange(40) // 20
    rng = np.random.default_rng(0)
    # of the first component's cameras a third tell nothing
    wild = np.isin(problem.ray_images, rng.choice(20, 7, replace=False))
    rays = problem.rays.copy()
    rays[wild] = rng.normal(size=(wild.sum(), 3))
    problem = replace(problem, rays=rays / np.linalg.norm(rays, axis=1, keepdims=True))
    problem = problem.select_edges(np.ones(len(problem.pairs), bool))
    found = position_components(problem.select_edges(slice(0)), components, SETTINGS, 5)
    np.testing.assert_array_equal(np.bincount(found.components + 1), [7, 20, 13])
    assert found.agreeing[0] > 0.9
    assert 0.5 < found.agreeing[1] < DOUBTFUL_SHARE
    assert np.mean(found.ray_residuals_rad < LIMITS.ray_rad) > 0.9


def test_cameras_along_a_chain_are_attached_without_locating_every_landmark_again(monkeypatch):
    truth = make_problem(60, 4000, "street", noise_px=0.3, rotation_noise_deg=0.05, seed=3)
    problem = positioning(truth)
    order = np.argsort(truth.centers[:, np.argmax(np.ptp(truth.centers, axis=0))])
    held = np.isin(np.arange(60), order[:6])
    located = []

    def locate(some, centers):
        located.append(len(some.rays))
        return locate_landmarks(some, centers)

    monkeypatch.setattr("snakesfm.translation_averaging.support.locate_landmarks", locate)
    centers = attach_cameras(problem, truth.centers, held, LIMITS)
    assert np.isfinite(centers).all()
    # the further from the held cameras, the more a chain is off
    assert np.linalg.norm(centers - truth.centers, axis=1)[order[:20]].max() < 0.2
    assert len(located) > 10 and sum(located[1:]) < 2 * located[0] == 2 * len(problem.rays)
