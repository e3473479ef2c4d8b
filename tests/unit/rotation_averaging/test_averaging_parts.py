"""Spanning trees, linear steps, noise models, reseating and rejection on synthetic truth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snakesfm.geometry.rotations import angle_of, exp_so3, log_so3
from snakesfm.rotation_averaging.base import RotationGraph, edge_residuals
from snakesfm.rotation_averaging.irls import IrlsAverager
from snakesfm.rotation_averaging.linear import solve_anisotropic, solve_isotropic
from snakesfm.rotation_averaging.noise import fill_covariances, fit_noise
from snakesfm.rotation_averaging.regroup import regroup_nodes
from snakesfm.rotation_averaging.rejection import residual_limit
from snakesfm.rotation_averaging.reseat import reseat_nodes
from snakesfm.rotation_averaging.tree import tree_rotations
from snakesfm.rotation_averaging.two_stage import TwoStageAverager
from snakesfm.rotation_averaging.verification import average_view_graph


def random_graph(node_count, edge_count, seed, node_bias=None):
    """A connected random graph: pairs, exact rotations, truth."""
    rng = np.random.default_rng(seed)
    chain = np.stack([np.arange(node_count - 1), np.arange(1, node_count)], axis=1)
    more = rng.integers(0, node_count, (edge_count, 2))
    more = np.sort(more[more[:, 0] != more[:, 1]], axis=1)
    pairs = np.unique(np.concatenate([chain, more]), axis=0)
    truth = Rotation.random(node_count, rng).as_matrix()
    return pairs, truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1), truth


def test_residuals_vanish_at_the_truth_and_are_nan_without_a_rotation():
    pairs, rotations, truth = random_graph(10, 30, 0)
    assert edge_residuals(pairs, rotations, truth).max() < 1e-7
    truth[4] = np.nan
    touched = (pairs == 4).any(axis=1)
    np.testing.assert_array_equal(np.isnan(edge_residuals(pairs, rotations, truth)), touched)


def test_tree_avoids_costly_edges():
    pairs, rotations, truth = random_graph(30, 80, 1)
    costs = np.ones(len(pairs))
    wrong = pairs[:, 1] - pairs[:, 0] > 1
    costs[wrong] = 50.0
    rotations[wrong] = np.eye(3)
    averaged = tree_rotations(30, pairs, rotations, costs)
    gauge = averaged[0].T @ truth[0]
    assert angle_of(averaged @ gauge @ truth.transpose(0, 2, 1)).max() < 1e-6


def test_tree_of_more_nodes_than_32_bits_can_pair():
    # the root is the last node, so that keys of its edges are the largest there are
    count = 50_000
    pairs = np.column_stack([np.arange(count - 1), np.full(count - 1, count - 1)])
    rng = np.random.default_rng(2)
    turns = Rotation.random(count - 1, random_state=rng).as_matrix()
    averaged = tree_rotations(count, pairs, turns, np.ones(len(pairs)))
    assert (
        angle_of(averaged[pairs[:, 1]] @ averaged[pairs[:, 0]].transpose(0, 2, 1) @ turns.mT).max() < 1e-6
    )


@pytest.mark.parametrize("edge_count", [60, 40_000])
def test_linear_steps_minimise_their_cost(edge_count):
    # 40,000 edges of 700 nodes are solved iteratively, few ones directly
    node_count = 20 if edge_count == 60 else 700
    pairs, _, _ = random_graph(node_count, edge_count, 2)
    rng = np.random.default_rng(3)
    residuals = rng.normal(size=(len(pairs), 3))
    weights = rng.uniform(0.1, 2.0, len(pairs))
    increments = solve_isotropic(node_count, pairs, weights, residuals)
    information = weights[:, None, None] * np.eye(3)
    np.testing.assert_allclose(
        solve_anisotropic(node_count, pairs, information, residuals), increments, atol=1e-4
    )
    np.testing.assert_array_equal(increments[0], 0)
    forces = weights[:, None] * (increments[pairs[:, 1]] - increments[pairs[:, 0]] - residuals)
    balance = np.zeros((node_count, 3))
    np.add.at(balance, pairs[:, 1], forces)
    np.add.at(balance, pairs[:, 0], -forces)
    assert np.abs(balance[1:]).max() < 1e-2 * np.abs(forces).max()


def test_noise_model_finds_the_scale_of_overconfident_covariances():
    rng = np.random.default_rng(4)
    roots = np.radians(rng.uniform(0.1, 1.0, (3000, 1)))
    residuals = roots * rng.normal(size=(3000, 3))
    given = roots[..., None] ** 2 * np.eye(3) / 25.0
    fitted = fit_noise(residuals, given)
    ratios = np.sqrt(fitted[:, 0, 0]) / roots[:, 0]
    # Student t on normal residuals: the scale is somewhat smaller than the deviation
    assert 0.6 < np.median(ratios) < 1.1
    assert ratios.std() < 0.15


def test_noise_model_prefers_equal_weights_to_meaningless_covariances():
    rng = np.random.default_rng(5)
    residuals = np.radians(0.5) * rng.normal(size=(2000, 3))
    meaningless = np.exp(rng.normal(0, 2, (2000, 1, 1))) * np.eye(3)
    fitted = fit_noise(residuals, meaningless)
    deviations = np.sqrt(fitted[:, 0, 0])
    assert np.percentile(deviations, 90) < 1.5 * np.percentile(deviations, 10)


def test_axes_that_the_residuals_do_not_bear_out_are_dropped():
    rng = np.random.default_rng(6)
    axes = Rotation.random(300, rng).as_matrix()
    sizes = rng.uniform(0.5, 2.0, 300)[:, None] * np.array([[1e-4, 1e-5, 1e-6]])
    given = axes @ (sizes[:, :, None] * axes.transpose(0, 2, 1))
    along = np.einsum("eij,ej->ei", axes, rng.normal(size=(300, 3)) * np.sqrt(sizes))
    alike = rng.normal(size=(300, 3)) * np.sqrt(sizes.mean(axis=1, keepdims=True))
    for residuals, least, most in ((along, 50.0, 120.0), (alike, 0.99, 1.01)):
        values = np.linalg.eigvalsh(fit_noise(residuals, given))
        assert least < np.median(values[:, 2] / values[:, 0]) < most
        # either way edges differ in size as they did
        ratios = values.sum(axis=1) / sizes.sum(axis=1)
        assert 0.5 < np.median(ratios) < 1.2 and ratios.std() < 0.05 * ratios.mean()


def test_noise_model_survives_zero_residuals():
    assert np.isfinite(fit_noise(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)))).all()


def test_unknown_covariances_follow_the_weights():
    covariances = np.tile(0.04 * np.eye(3), (3, 1, 1))
    covariances[1] = np.nan
    filled = fill_covariances(covariances, np.array([10.0, 40.0, 10.0]))
    np.testing.assert_array_equal(filled[[0, 2]], covariances[[0, 2]])
    np.testing.assert_allclose(filled[1], 0.01 * np.eye(3))
    unknown = fill_covariances(np.full((2, 3, 3), np.nan), np.array([1.0, 4.0]))
    np.testing.assert_allclose(unknown[0], 4.0 * unknown[1])


def test_reseating_frees_a_stuck_node():
    pairs, rotations, truth = random_graph(15, 80, 6)
    graph = RotationGraph(15, pairs, rotations, np.ones(len(pairs)), np.full((len(pairs), 3, 3), np.nan))
    stuck = truth.copy()
    stuck[7] = Rotation.from_rotvec([0, 2.0, 0]).as_matrix() @ stuck[7]
    assert angle_of(reseat_nodes(graph, stuck, 0.1) @ truth.transpose(0, 2, 1)).max() < 1e-6
    np.testing.assert_array_equal(reseat_nodes(graph, truth, 0.1), truth)


@pytest.mark.parametrize(
    ("residuals", "expected"), [([0.1, 0.1, np.nan], 5.0), ([9.0, 9.0, 9.0], 10.0), ([2.0, 2.0], 6.5)]
)
def test_limit_adapts_within_bounds(residuals, expected):
    assert residual_limit(np.array(residuals), 5.0, 10.0) == pytest.approx(expected, abs=0.01)


def test_confident_outliers_do_not_spoil_the_gain_of_covariances():
    pairs, rotations, truth = random_graph(80, 400, 9)
    rng = np.random.default_rng(10)
    roots = np.radians(2.0) * np.exp(rng.normal(0, 1.2, len(pairs)))
    noise = Rotation.from_rotvec(roots[:, None] * rng.normal(size=(len(pairs), 3))).as_matrix()
    rotations = noise @ rotations
    wrong = rng.uniform(size=len(pairs)) < 0.1
    rotations[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
    # outliers are as confident as they can be, and all are over-confident
    roots[wrong] = roots.min()
    covariances = (roots[:, None, None] / 3.0) ** 2 * np.eye(3)
    errors = {}
    for averager in (IrlsAverager(), TwoStageAverager()):
        averaged = averager.average(80, pairs, rotations, None, covariances)
        gauge = averaged.transpose(0, 2, 1) @ truth
        mean = Rotation.from_matrix(gauge).mean().as_matrix()
        errors[type(averager)] = np.degrees(angle_of(gauge @ mean.T)).mean()
    assert 0.05 < errors[TwoStageAverager] < 0.75 * errors[IrlsAverager]


def test_a_group_on_one_wrong_edge_is_joined_by_its_right_ones():
    rng = np.random.default_rng(11)
    truth = Rotation.random(12, rng).as_matrix()
    inside = [(i, j) for i in range(12) for j in range(i + 1, 12) if (i < 6) == (j < 6)]
    pairs = np.array(sorted([*inside, (0, 6), (1, 8), (4, 11)]))
    rotations = truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    turn = Rotation.from_rotvec([0, 1.5, 0]).as_matrix()
    wrong = (pairs == (1, 8)).all(axis=1)
    rotations[wrong] = turn @ rotations[wrong]
    weights = np.where(wrong, 150.0, 50.0)
    graph = RotationGraph(12, pairs, rotations, weights, np.full((len(pairs), 3, 3), np.nan))
    held = truth.copy()
    held[6:] = truth[6:] @ (truth[8].T @ turn @ truth[8])
    assert edge_residuals(pairs, rotations, held)[wrong].max() < 1e-6
    joined = regroup_nodes(graph, held, 0.17)
    gauge = joined[0].T @ truth[0]
    assert angle_of(joined @ gauge @ truth.transpose(0, 2, 1)).max() < 1e-3


def test_dense_graphs_are_thinned_and_stay_connected():
    pairs, rotations, _ = random_graph(60, 3000, 12)
    graph = RotationGraph(60, pairs, rotations, np.ones(len(pairs)), np.full((len(pairs), 3, 3), np.nan))
    thin = graph.thin(10)
    degrees = np.bincount(thin.pairs.ravel(), minlength=60)
    assert degrees.min() >= 10 and len(thin.pairs) <= 600 < len(pairs)
    assert graph.thin(60) is graph


def test_refused_edges_that_agree_are_taken_back_and_wrong_ones_refused():
    pairs, rotations, truth = random_graph(40, 300, 13)
    rng = np.random.default_rng(14)
    wrong = (rng.uniform(size=len(pairs)) < 0.25) & (pairs[:, 1] - pairs[:, 0] > 1)
    rotations[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
    filtered = np.where(wrong ^ (rng.uniform(size=len(pairs)) < 0.1), "cycle_message", "kept").astype(
        object
    )
    filtered[pairs[:, 1] - pairs[:, 0] == 1] = "kept"
    graph = RotationGraph(40, pairs, rotations, np.ones(len(pairs)), np.full((len(pairs), 3, 3), np.nan))
    averaged, reasons, components = average_view_graph(TwoStageAverager(), graph, filtered, 5.0, 10.0)
    assert (components == 0).all()
    assert (reasons[~wrong] == "kept").all()
    assert np.mean(reasons[wrong] == "kept") < 0.05
    assert set(reasons) == {"kept", "rotation_residual", "cycle_message"}
    gauge = averaged[0].T @ truth[0]
    assert np.degrees(angle_of(averaged @ gauge @ truth.transpose(0, 2, 1))).max() < 0.1


def network(seed, outliers):
    """A ring of 80 cameras: noise by inlier count, wrong edges as sure as right ones."""
    rng = np.random.default_rng(seed)
    pairs = np.unique(
        np.sort(np.array([(i, (i + step) % 80) for i in range(80) for step in range(1, 9)]), axis=1), axis=0
    )
    truth = Rotation.random(80, rng).as_matrix()
    counts = np.exp(rng.uniform(np.log(20), np.log(800), len(pairs)))
    sigmas = np.radians(4.0) / np.sqrt(counts) * np.exp(rng.normal(0, 0.5, len(pairs)))
    noise = Rotation.from_rotvec(sigmas[:, None] * rng.normal(size=(len(pairs), 3))).as_matrix()
    exact = truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    wrong = rng.uniform(size=len(pairs)) < outliers
    exact[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
    return pairs, noise @ exact, counts, sigmas[:, None, None] ** 2 * np.eye(3), truth, sigmas, wrong


@pytest.mark.parametrize("outliers", [0.0, 0.2, 0.4])
def test_networks_are_averaged_nearly_as_well_as_without_outliers(outliers):
    pairs, rotations, counts, covariances, truth, sigmas, wrong = network(15, outliers)
    averaged = TwoStageAverager().average(80, pairs, rotations, counts, covariances)
    best = truth
    for _ in range(3):
        tails = best[pairs[~wrong, 1]]
        information = np.eye(3) / sigmas[~wrong, None, None] ** 2
        residuals = log_so3(tails.transpose(0, 2, 1) @ rotations[~wrong] @ best[pairs[~wrong, 0]])
        best = best @ exp_so3(solve_anisotropic(80, pairs[~wrong], information, residuals))
    errors = []
    for solution in (averaged, best):
        gauge = solution.transpose(0, 2, 1) @ truth
        errors.append(np.degrees(angle_of(gauge @ Rotation.from_matrix(gauge).mean().as_matrix().T)).mean())
    assert 0.02 < errors[1] < 0.5
    assert 0.9 * errors[1] < errors[0] < 1.4 * errors[1]


def test_axes_of_covariances_are_those_of_the_second_camera():
    pairs, exact, truth = random_graph(30, 200, 0)
    rng = np.random.default_rng(50)
    axes = Rotation.random(len(pairs), rng).as_matrix()
    sigmas = np.radians([0.1, 0.1, 2.0])
    noise = np.einsum("eij,ej->ei", axes, rng.normal(size=(len(pairs), 3)) * sigmas)
    along = axes @ np.diag(sigmas**2) @ axes.transpose(0, 2, 1)
    alike = np.tile(np.mean(sigmas**2) * np.eye(3), (len(pairs), 1, 1))
    errors = []
    for covariances in (along, alike):
        averaged = TwoStageAverager().average(30, pairs, exp_so3(noise) @ exact, None, covariances)
        gauge = averaged.transpose(0, 2, 1) @ truth
        mean = Rotation.from_matrix(gauge).mean().as_matrix()
        errors.append(np.degrees(np.sqrt(np.mean(angle_of(gauge @ mean.T) ** 2))))
    assert 0.03 < errors[0] < 0.35 * errors[1]
