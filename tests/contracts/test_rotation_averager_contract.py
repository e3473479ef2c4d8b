"""What every rotation averager must do."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snakesfm.errors import SceneError
from snakesfm.geometry.rotations import angle_of
from snakesfm.rotation_averaging.base import RotationAverager
from snakesfm.rotation_averaging.registry import make_averager


def ring_graph(node_count, reach, noise_rad=0.0, seed=0):
    """A ring whose nodes are paired with the next ``reach`` ones: pairs, rotations, truth."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(node_count, rng).as_matrix()
    steps = [(i, (i + step) % node_count) for i in range(node_count) for step in range(1, reach + 1)]
    pairs = np.unique(np.sort(np.array(steps), axis=1), axis=0)
    exact = truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    noise = Rotation.from_rotvec(noise_rad * rng.normal(size=(len(pairs), 3))).as_matrix()
    return pairs, noise @ exact, truth


def errors_deg(averaged, truth):
    """Angles to the truth when the first known nodes are aligned."""
    known = np.flatnonzero(np.isfinite(averaged[:, 0, 0]))
    gauge = averaged[known].transpose(0, 2, 1) @ truth[known]
    mean = Rotation.from_matrix(gauge).mean().as_matrix()
    return np.degrees(angle_of(gauge @ mean.T))


class AveragerContract:
    """Every averager's test class inherits this and names its method."""

    method = ""

    @pytest.fixture
    def averager(self) -> RotationAverager:
        return make_averager(self.method)

    @pytest.mark.parametrize("reach", [1, 3])
    def test_exact_measurements_give_exact_rotations(self, averager, reach):
        pairs, rotations, truth = ring_graph(20, reach)
        averaged = averager.average(20, pairs, rotations)
        assert errors_deg(averaged, truth).max() < 1e-3

    def test_first_image_is_the_gauge(self, averager):
        pairs, rotations, _ = ring_graph(12, 2, 0.01)
        averaged = averager.average(15, pairs + 3, rotations)
        np.testing.assert_array_equal(averaged[3], np.eye(3))
        assert np.isnan(averaged[:3]).all()
        np.testing.assert_allclose(np.linalg.det(averaged[3:]), 1.0, atol=1e-6)

    def test_two_images_give_their_edge(self, averager):
        rotation = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
        averaged = averager.average(2, np.array([[0, 1]]), rotation[None])
        np.testing.assert_allclose(averaged[1], rotation, atol=1e-6)

    @pytest.mark.parametrize("shape", ["chain", "star"])
    def test_trees_satisfy_every_edge(self, averager, shape):
        truth = Rotation.random(9, np.random.default_rng(3)).as_matrix()
        heads = np.arange(8) if shape == "chain" else np.zeros(8, dtype=int)
        pairs = np.stack([heads, np.arange(1, 9)], axis=1)
        rotations = truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
        averaged = averager.average(9, pairs, rotations, np.arange(1.0, 9.0))
        assert errors_deg(averaged, truth).max() < 1e-3

    def test_gaps_and_small_components_are_nan(self, averager):
        pairs, rotations, truth = ring_graph(8, 2)
        apart = np.array([[30, 33]])
        averaged = averager.average(
            40, np.concatenate([4 * pairs, apart])[:], np.concatenate([rotations, np.eye(3)[None]])
        )
        known = np.isfinite(averaged[:, 0, 0])
        np.testing.assert_array_equal(np.flatnonzero(known), 4 * np.arange(8))
        assert errors_deg(averaged[known], truth).max() < 1e-3

    def test_noise_is_averaged(self, averager):
        pairs, rotations, truth = ring_graph(40, 4, np.radians(1.0), seed=5)
        covariances = np.tile(np.radians(1.0) ** 2 * np.eye(3), (len(pairs), 1, 1))
        averaged = averager.average(40, pairs, rotations, np.full(len(pairs), 100.0), covariances)
        assert 0.2 < errors_deg(averaged, truth).mean() < 2.0

    def test_unknown_covariances_do_no_harm(self, averager):
        pairs, rotations, truth = ring_graph(15, 3, np.radians(0.5))
        covariances = np.full((len(pairs), 3, 3), np.nan)
        averaged = averager.average(15, pairs, rotations, np.full(len(pairs), 50), covariances)
        assert 0.05 < errors_deg(averaged, truth).mean() < 1.0

    def test_same_input_gives_same_bits(self, averager):
        pairs, rotations, _ = ring_graph(25, 3, 0.02)
        first = averager.average(25, pairs, rotations)
        np.testing.assert_array_equal(first, averager.average(25, pairs, rotations))

    def test_no_edge_is_a_clear_error(self, averager):
        with pytest.raises(SceneError, match="no edge"):
            averager.average(3, np.zeros((0, 2), int), np.zeros((0, 3, 3)))

    @pytest.mark.parametrize("pair", [(0, 3), (-1, 1), (1, 0), (1, 1)])
    def test_bad_pairs_are_refused(self, averager, pair):
        with pytest.raises(ValueError, match="pair"):
            averager.average(3, np.array([pair]), np.eye(3)[None])

    def test_non_finite_rotations_are_refused(self, averager):
        with pytest.raises(ValueError, match="finite"):
            averager.average(2, np.array([[0, 1]]), np.full((1, 3, 3), np.nan))


class RobustAveragerContract(AveragerContract):
    """What averagers that promise robustness must do besides."""

    @pytest.mark.parametrize("share", [0.1, 0.25])
    def test_random_outliers_have_no_say(self, averager, share):
        pairs, rotations, truth = ring_graph(60, 6, np.radians(0.5), seed=7)
        rng = np.random.default_rng(8)
        wrong = rng.uniform(size=len(pairs)) < share
        rotations[wrong] = Rotation.random(int(wrong.sum()), rng).as_matrix()
        averaged = averager.average(60, pairs, rotations)
        assert 0.1 < errors_deg(averaged, truth).mean() < 1.0


class TestTwoStage(RobustAveragerContract):
    method = "two_stage"


class TestIrls(RobustAveragerContract):
    method = "irls"


class TestShonan(AveragerContract):
    method = "shonan"


def test_unknown_averager_is_refused():
    with pytest.raises(ValueError, match="two_stage"):
        make_averager("median")
