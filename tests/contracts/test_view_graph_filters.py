"""What every method must do that judges the edges of a view graph by their cycles."""

import itertools

import numpy as np
import pytest
from noisy_graph import noisy_graph
from scipy.spatial.transform import Rotation

from snakesfm.artifacts.pairs import EDGE_LABELS
from snakesfm.config.filter_view_graph import FilterViewGraphOptions
from snakesfm.stages.filter_view_graph import refuse_edges
from snakesfm.view_graph.cycles import find_cycles

NODES = 40


class ViewGraphFilterContract:
    """Inherit and set ``method``."""

    method = ""

    def refuse(self, node_count, pairs, rotations, **options):
        """What refuses each edge, without the vote that follows either method."""
        cycles, inlier_counts = find_cycles(node_count, pairs, rotations), np.full(len(pairs), 50)
        chosen = FilterViewGraphOptions(method=self.method, cluster_vote=False, **options)
        return refuse_edges(node_count, pairs, rotations, inlier_counts, cycles, chosen)

    @pytest.fixture
    def graph(self):
        """Pairs, rotations, and which edges are wrong: one of five."""
        return noisy_graph(NODES, 0.7, 4, wrong_share=0.2)

    def test_right_edges_are_kept_and_wrong_ones_refused(self, graph):
        pairs, rotations, wrong = graph
        reasons = self.refuse(NODES, pairs, rotations)
        assert reasons.shape == (len(pairs),) and set(reasons) <= set(EDGE_LABELS)
        kept = reasons == "kept"
        assert kept[~wrong].mean() > 0.97 and kept[wrong].mean() < 0.05
        assert all(reason.startswith("cycle_") for reason in reasons[~kept])

    @pytest.mark.parametrize(("factor", "kept"), [(0.9, True), (1.1, False)])
    def test_cycles_off_by_more_than_the_limit_refuse_their_edges(self, factor, kept):
        pairs = np.array(list(itertools.combinations(range(9), 2)))
        rotations = np.tile(np.eye(3), (len(pairs), 1, 1))
        rotations[0] = Rotation.from_rotvec([0.0, 0.0, factor * np.radians(7.0)]).as_matrix()
        reasons = self.refuse(9, pairs, rotations, max_cycle_error_deg=7.0)
        assert (reasons[0] == "kept") == kept
        assert (reasons[1:] == "kept").all()

    def test_a_limit_of_half_a_turn_refuses_nothing(self, graph):
        pairs, rotations, _ = graph
        assert (self.refuse(NODES, pairs, rotations, max_cycle_error_deg=180.0) == "kept").all()

    def test_edges_in_no_cycle_are_kept(self, graph):
        pairs, rotations, _ = graph
        hanging = np.concatenate([pairs, [[NODES - 1, NODES]]])
        turned = np.concatenate([rotations, Rotation.from_rotvec([[2.0, 0.0, 0.0]]).as_matrix()])
        reasons = self.refuse(NODES + 1, hanging, turned)
        assert reasons[-1] == "kept" and (reasons != "kept").any()

    def test_a_chain_and_nothing_at_all_are_kept(self):
        chain = np.array([[0, 1], [1, 2], [2, 3]])
        assert (self.refuse(4, chain, np.tile(np.eye(3), (3, 1, 1))) == "kept").all()
        assert self.refuse(4, np.zeros((0, 2), int), np.zeros((0, 3, 3))).shape == (0,)

    def test_the_numbers_of_the_images_change_nothing(self, graph):
        pairs, rotations, _ = graph
        # turned about, every pair (i, j) becomes (N-1-j, N-1-i), and the sorted order another one
        mirrored = NODES - 1 - pairs[:, ::-1]
        order = np.lexsort((mirrored[:, 1], mirrored[:, 0]))
        reasons = self.refuse(NODES, pairs, rotations)
        same = self.refuse(NODES, mirrored[order], rotations.transpose(0, 2, 1)[order])
        np.testing.assert_array_equal(same == "kept", reasons[order] == "kept")

    def test_is_deterministic(self, graph):
        pairs, rotations, _ = graph
        np.testing.assert_array_equal(*(self.refuse(NODES, pairs, rotations) for _ in range(2)))


class TestMessagePassing(ViewGraphFilterContract):
    method = "message_passing"


class TestCycles(ViewGraphFilterContract):
    method = "cycles"
