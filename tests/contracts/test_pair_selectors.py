"""What every choice of image pairs must do."""

import numpy as np
import pytest

from snakesfm.retrieval.listed import listed_pairs
from snakesfm.retrieval.pairs import (
    REASONS,
    exhaustive_pairs,
    sequential_pairs,
    similar_pairs,
    spatial_pairs,
)


class PairSelectorContract:
    """Inherit, set ``reason`` and say how to choose among ``count`` images."""

    reason = ""

    def select(self, count):
        raise NotImplementedError

    @pytest.mark.parametrize("count", [0, 1, 2, 3, 40])
    def test_pairs_are_proper_sorted_and_distinct(self, count):
        table = self.select(count)
        pairs = table.pairs
        assert pairs.shape == (len(table.reasons), 2) and table.similarities.shape == table.reasons.shape
        assert (pairs[:, 0] < pairs[:, 1]).all()
        assert len(pairs) == 0 or (pairs.min() >= 0 and pairs.max() < count)
        keys = pairs[:, 0] * 1000 + pairs[:, 1]
        assert (np.diff(keys) > 0).all()
        assert set(table.reason_texts()) <= {self.reason}

    def test_two_images_are_a_pair(self):
        np.testing.assert_array_equal(self.select(2).pairs, [[0, 1]])

    def test_is_deterministic(self):
        first, second = self.select(30), self.select(30)
        np.testing.assert_array_equal(first.pairs, second.pairs)
        np.testing.assert_array_equal(first.similarities, second.similarities)

    def test_a_union_with_itself_changes_nothing(self):
        table = self.select(12)
        both = table.union(table)
        np.testing.assert_array_equal(both.pairs, table.pairs)
        np.testing.assert_array_equal(both.reasons, table.reasons)
        np.testing.assert_array_equal(both.similarities, table.similarities)

    def test_the_reason_is_known(self):
        assert self.reason in REASONS


class TestExhaustive(PairSelectorContract):
    reason = "exhaustive"

    def select(self, count):
        return exhaustive_pairs(count)


class TestSequential(PairSelectorContract):
    reason = "sequential"

    def select(self, count):
        return sequential_pairs([f"img{k}.jpg" for k in range(count)], 3)


class TestRetrieval(PairSelectorContract):
    reason = "retrieved"

    def select(self, count):
        vectors = np.random.default_rng(1).normal(size=(count, 16)) + 2
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        return similar_pairs([np.arange(count)], lambda block: vectors.astype(np.float32), 3, 0.0)


class TestSpatial(PairSelectorContract):
    reason = "spatial"

    def select(self, count):
        return spatial_pairs(np.random.default_rng(2).random((count, 2)) * 100.0, 3)


class TestListed(PairSelectorContract):
    reason = "listed"

    def select(self, count):
        names = [f"{k}.jpg" for k in range(count)]
        lines = [f"{k + 1}.jpg {k}.jpg" for k in range(count - 1)]
        return listed_pairs(lines + lines, names, [], "pairs.txt")[0]
