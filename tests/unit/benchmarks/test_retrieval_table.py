"""The table of retrievals counts what it says."""

import numpy as np
import pytest

from benchmarks.retrieval import BUDGETS, rank_pairs, recalls, render
from snakesfm.retrieval.pairs import similarities_of


def test_the_best_pairs_of_every_image_come_first():
    similarities = np.array(
        [[1, 0.9, 0.2, 0.3], [0.9, 1, 0.1, 0.4], [0.2, 0.1, 1, 0.15], [0.3, 0.4, 0.15, 1]]
    )
    ranked = list(map(tuple, rank_pairs(similarities).tolist()))
    # first the best partner of each image, even of image 2, which resembles none well
    assert ranked == [(0, 1), (1, 3), (0, 2), (0, 3), (2, 3), (1, 2)]


def test_an_image_without_features_is_in_no_pair():
    vectors = np.array([[1, 0], [-1, 0], [0, 0], [0, 1]], np.float32)
    ranked = rank_pairs(similarities_of(vectors, vectors))
    assert sorted(map(tuple, ranked.tolist())) == [(0, 1), (0, 3), (1, 3)]
    # the opposite one comes last
    assert ranked[-1].tolist() == [0, 1]


def test_recall_is_counted_within_the_budget():
    count = 30
    overlapping = np.triu(np.ones((count, count), bool), 1)
    pairs = np.column_stack(np.triu_indices(count, 1))
    every = count * (count - 1) / 2
    expected = [100 * min(budget * count, every) / every for budget in BUDGETS]
    assert recalls(pairs, overlapping) == pytest.approx(expected)
    assert recalls(pairs, np.zeros_like(overlapping)) == [0, 0, 0]


def test_rows_ceilings_failures_and_means():
    one = {"images": 10, "pairs": 45, "overlapping": 40, "recalls": [50.0, 75.0, 100.0]}
    values = {"a|sequential": one, "a|netvlad": {"failure": "no weights"}, "b|sequential": one}
    text = render(values, ["a", "b"], ["sequential", "netvlad"])
    assert "## a: 10 images, 40 of 45 pairs overlap" in text
    assert "| sequential | 50.0 | 75.0 | 100.0 |" in text and "| netvlad | no weights |" in text
    assert "| possible | 75.0 | 100.0 | 100.0 |" in text and "| by chance | 66.7 | 100.0 | 100.0 |" in text
    # no set was finished by both
    assert text.count("## Mean") == 1 and "## Mean of 2 sets" in text
    assert text.count("| sequential | 50.0 |") == 3 and text.count("| netvlad |") == 2
    values["b|netvlad"] = {**one, "recalls": [10.0, 20.0, 30.0]}
    text = render(values, ["a", "b"], ["sequential", "netvlad"])
    assert (
        "## Mean of 2 sets" in text and "## Mean of 1 sets" in text and text.count("| netvlad | 10.0") == 2
    )
    values["a|netvlad"] = one
    text = render(values, ["a", "b"], ["sequential", "netvlad"])
    assert text.count("## Mean") == 1 and "| netvlad | 30.0 | 47.5 | 65.0 |" in text
