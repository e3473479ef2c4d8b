"""What single averagers do, and that their options reach them."""

import numpy as np
import pytest
from positioned_cameras import CHAIN, averager, errors, positioning, thinned

from snakesfm.synthetic.problems import make_problem, perturb_rotations
from snakesfm.translation_averaging.averagers import share_at_one_scale, with_rays
from snakesfm.translation_averaging.recovery import mfas_weights
from snakesfm.translation_averaging.scale_chain import chain_centers


def test_mfas_weighs_wrong_directions_more():
    truth = make_problem(30, 3000, "area", pair_outlier_ratio=0.15, seed=3)
    weights = mfas_weights(positioning(truth), 60, 0)
    assert weights[truth.edge_outliers].mean() > 3.0 * weights[~truth.edge_outliers].mean()


@pytest.mark.parametrize("seed", [1, 2])
def test_scale_chain_withstands_a_third_of_wrong_pairs(seed):
    truth = make_problem(30, 1500, "area", 0.7, 0.1, 0.3, 0.35, seed=seed)
    found = errors(CHAIN.position(thinned(positioning(truth)), 0), truth.centers)
    assert len(found) == 30
    assert 1e-4 < np.median(found) < 0.004 and found.max() < 0.04


def test_loss_scale_of_global_positioning_says_which_rays_count():
    truth = make_problem(8, 150, "area", noise_px=0.5, outlier_ratio=0.1, seed=3)
    robust, plain = (averager("global_positioning", positioning_loss_scale=scale) for scale in (1e-3, 10.0))
    problem = thinned(positioning(truth))
    found = [errors(a.position(problem, 0), truth.centers) for a in (robust, plain)]
    assert 1e-4 < np.median(found[0]) < 0.1 * np.median(found[1])


def test_the_chain_of_translation_recovery_has_the_options_of_its_own(monkeypatch):
    problem = with_rays(positioning(make_problem(10, 600, "area", seed=3)), 20)
    told = []

    def chain(rays, *limits):
        told.append((len(rays.rays), *limits))
        return chain_centers(rays, *limits)

    monkeypatch.setattr("snakesfm.translation_averaging.averagers.chain_centers", chain)
    few = {"recovery_rays_per_camera": 5, "ray_sigma_deg": 0.5, "max_relative_sigma": 0.2}
    for method in ("scale_chain", "translation_recovery"):
        averager(method, **few).position(problem, 0)
    assert told == [(len(problem.rays), 1.5 * np.radians(0.5), 0.2)] * 2


def test_recovery_has_no_more_rays_than_take_part():
    problem = positioning(make_problem(30, 1500, "area", seed=3))
    chosen = with_rays(problem, 20)
    assert len(with_rays(chosen, 10).rays) < len(chosen.rays) < len(problem.rays)
    for again in (20, 300):
        np.testing.assert_array_equal(with_rays(chosen, again).rays, chosen.rays)


def test_what_the_chain_falls_back_to_has_the_options_of_recovery():
    truth = make_problem(12, 600, "area", 0.5, 0.1, 0.3, 0.2, seed=6)
    pairs_alone = positioning(truth)
    pairs_alone = pairs_alone.select_rays(np.zeros(len(pairs_alone.rays), dtype=bool))
    found = {
        (method, reject): averager(method, reject_outliers=reject).position(pairs_alone, 0)
        for method in ("scale_chain", "translation_recovery")
        for reject in ("none", "residual")
    }
    for reject in ("none", "residual"):
        np.testing.assert_array_equal(found["scale_chain", reject], found["translation_recovery", reject])
    assert not np.array_equal(found["scale_chain", "none"], found["scale_chain", "residual"])


def test_cameras_at_one_scale_are_those_whose_baselines_agree():
    count = 20
    line = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(float)
    pairs = np.concatenate([np.stack([np.arange(count - k), np.arange(k, count)], axis=1) for k in (1, 2)])
    assert share_at_one_scale(pairs, 7.0 * line + 3.0, line) == 1.0
    apart = line.copy()
    apart[12:] += 1000.0
    assert share_at_one_scale(pairs, apart, line) == 0.6
    shrunk = line.copy()
    shrunk[12:] = line[12] + (line[12:] - line[12]) / 1000.0
    # the first two of the shrunken ones still are about as far from those before as they were
    assert share_at_one_scale(pairs, shrunk, line) == 0.7
    assert share_at_one_scale(pairs, np.where(np.arange(count)[:, None] < 12, apart, np.nan), line) == 1.0
    assert share_at_one_scale(pairs[:0], line, line) == 1.0


@pytest.mark.parametrize("reject_outliers", ["none", "mfas"])
def test_recovery_in_parts_at_scales_of_their_own_gives_way_to_the_chain(reject_outliers, capsys):
    truth = make_problem(40, 1600, "street", 1.0, 0.3, 1.0, 0.3, seed=5)
    problem = thinned(positioning(truth, perturb_rotations(truth.rotations, 0.2, 3)))
    recovery = averager("translation_recovery", reject_outliers=reject_outliers)
    found = recovery.position(problem, 0)
    np.testing.assert_array_equal(found, CHAIN.position(problem, 0))
    assert "scale_chain positions the cameras instead" in capsys.readouterr().out
    assert np.median(errors(found, truth.centers)) < 0.01 * np.ptp(truth.centers, axis=0).max()


def test_recovery_at_one_scale_is_kept(capsys):
    problem = thinned(positioning(make_problem(20, 800, "area", 0.5, 0.1, 0.3, 0.1, seed=2)))
    found = averager("translation_recovery", reject_outliers="none").position(problem, 0)
    assert np.isfinite(found).all() and not np.array_equal(found, CHAIN.position(problem, 0))
    assert capsys.readouterr().out == ""
