"""Clusters of cameras that share no landmarks, and the edges that join them."""

from dataclasses import replace

import numpy as np
import pytest
from positioned_cameras import SETTINGS, errors, positioning

from snakesfm.synthetic.problems import make_problem
from snakesfm.translation_averaging.average import average_translations
from snakesfm.translation_averaging.clusters import join_by_edges
from snakesfm.translation_averaging.problem import PositioningProblem
from snakesfm.translation_averaging.scale_chain import chain_centers


def join_two_clusters(seed: int, ties: int, wrong: int) -> float | None:
    """Mean error of the second of two clusters, each 8 cameras about 3 wide, by edges some of them wrong."""
    rng = np.random.default_rng(seed)
    centers = np.concatenate([rng.normal(size=(8, 3)) * 3, rng.normal(size=(8, 3)) * 3 + [8, 0, 0]])
    within = [(i, j) for first in (0, 8) for i in range(first, first + 8) for j in range(i + 1, first + 8)]
    between = rng.permutation(64)[:ties]
    pairs = np.concatenate([within, np.column_stack([between // 8, 8 + between % 8])])
    directions = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions += rng.normal(size=directions.shape) * np.radians(0.5)
    if wrong:
        directions[-wrong:] = rng.normal(size=(wrong, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    none = np.zeros(0, np.int64)
    problem = PositioningProblem(16, pairs, directions, np.ones(len(pairs)), none, none, np.zeros((0, 3)))
    first, second = centers.copy(), (centers - [3, 1, 2]) * 0.37
    first[8:], second[:8] = np.nan, np.nan
    joined = join_by_edges(problem, [first, second], 0.1)[0][8:]
    return float(np.linalg.norm(joined - centers[8:], axis=1).mean()) if np.isfinite(joined).all() else None


@pytest.mark.parametrize(
    ("ties", "wrong", "joined", "wrongly"), [(3, 0, 40, 0), (3, 1, 0, 3), (4, 1, 30, 1), (4, 2, 0, 4)]
)
def test_clusters_are_joined_by_more_edges_than_fit_by_chance(ties, wrong, joined, wrongly) -> None:
    errors = [join_two_clusters(seed, ties, wrong) for seed in range(80)]
    found = np.array([error for error in errors if error is not None])
    assert joined <= len(found) <= 80
    assert np.count_nonzero(found > 1.5) <= wrongly


def two_clusters(edges_between):
    """Thirty cameras of which the last ten share no landmark with the others, and some edges between them."""
    truth = make_problem(30, 3000, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=3)
    problem = positioning(truth)
    second = np.arange(30) >= 20
    across = second[problem.pairs[:, 0]] != second[problem.pairs[:, 1]]
    kept = ~across
    kept[np.flatnonzero(across)[edges_between]] = True
    tracks = 2 * problem.ray_tracks + second[problem.ray_images]
    order = np.lexsort((problem.ray_images, tracks))
    apart = replace(
        problem,
        ray_images=problem.ray_images[order],
        ray_tracks=tracks[order],
        rays=problem.rays[order],
    )
    return truth, apart.select_edges(kept), second


@pytest.mark.parametrize("averager", ["chain", "whole"])
def test_clusters_without_common_landmarks_are_joined_by_edges(averager):
    truth, problem, second = two_clusters(slice(0, 40, 10))
    if averager == "chain":
        centers = chain_centers(problem, np.radians(0.45), 0.1)[0]
    else:
        centers = average_translations(problem, SETTINGS).centers
    assert np.isfinite(centers).all()
    extent = np.linalg.norm(np.ptp(truth.centers, axis=0))
    assert errors(centers, truth.centers).max() < 0.02 * extent
    # each cluster has its shape from landmarks, so it is what lies between them that may err
    assert errors(centers[second], truth.centers[second]).max() < 0.005 * extent


def test_a_wrong_edge_between_clusters_is_outvoted():
    truth, problem, second = two_clusters(slice(0, 50, 10))
    across = np.flatnonzero(second[problem.pairs[:, 0]] != second[problem.pairs[:, 1]])
    directions = problem.directions.copy()
    directions[across[0]] = np.roll(directions[across[0]], 1)
    centers = chain_centers(replace(problem, directions=directions), np.radians(0.45), 0.1)[0]
    extent = np.linalg.norm(np.ptp(truth.centers, axis=0))
    assert np.isfinite(centers).all() and errors(centers, truth.centers).max() < 0.02 * extent


@pytest.mark.parametrize("edges_between", [slice(0, 0), slice(0, 1)])
def test_a_cluster_stays_out_where_edges_do_not_tell_its_scale(edges_between):
    truth, problem, second = two_clusters(edges_between)
    centers, apart = chain_centers(problem, np.radians(0.45), 0.1)
    assert np.array_equal(np.isfinite(centers[:, 0]), ~second)
    assert np.array_equal(apart, second)
    assert errors(centers, truth.centers).max() < 0.005 * np.linalg.norm(np.ptp(truth.centers, axis=0))


@pytest.mark.parametrize(("directions", "count"), [("true", 10), ("random", 0), ("negated", 0)])
def test_a_cluster_stays_out_where_edges_contradict_each_other_or_its_direction(directions, count):
    _, problem, second = two_clusters(slice(None))
    across = second[problem.pairs[:, 0]] != second[problem.pairs[:, 1]]
    others = problem.directions.copy()
    if directions == "random":
        others[across] = np.random.default_rng(1).normal(size=(across.sum(), 3))
        others /= np.linalg.norm(others, axis=1, keepdims=True)
    elif directions == "negated":
        others[across] *= -1.0
    centers, apart = chain_centers(replace(problem, directions=others), np.radians(0.45), 0.1)
    assert np.isfinite(centers[~second]).all()
    assert np.isfinite(centers[second, 0]).sum() == count == 10 - apart.sum()
