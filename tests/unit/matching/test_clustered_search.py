import numpy as np
import pytest

from snakesfm.features.sift import rootsift
from snakesfm.matching import clustered
from snakesfm.matching.clustered import ClusteredSearch, learn_small_codebook

RATIO = 0.8


def scene(seed, first=1500, second=1300, shared=600, kinds=40):
    """Descriptors of two images with ``shared`` common points, clustered as real ones are, and the truth."""
    rng = np.random.default_rng(seed)
    prototypes = rng.exponential(size=(kinds, 128)) ** 0.7
    points = prototypes[rng.integers(0, kinds, first + second)] * rng.exponential(
        size=(first + second, 128)
    )
    again = points[:shared] * rng.uniform(0.2, 1.8, (shared, 128)) ** 1.5
    order = rng.permutation(second)
    others = np.concatenate([again, points[first : first + second - shared]])
    truth = np.argsort(order)[:shared]
    return rootsift(points[:first].astype(np.float32)), rootsift(others[order].astype(np.float32)), truth


def exact_search(descriptors):
    """All descriptors have the same word; a contract compares this with the definition."""
    return ClusteredSearch.build(descriptors, words=1, probes=1)


def as_set(matches):
    return set(map(tuple, matches.tolist()))


def test_finds_nearly_all_that_exact_search_finds_and_little_else():
    hit = wrong = right = exact_right = exact_wrong = 0
    for seed in range(4):
        first, second, truth = scene(seed)
        true = {(row, int(column)) for row, column in enumerate(truth)}
        exact = as_set(exact_search(first).match(second, RATIO)[0])
        found = as_set(ClusteredSearch.build(first, 16, 2).match(second, RATIO)[0])
        hit += len(exact & found & true)
        right, wrong = right + len(found & true), wrong + len(found - true)
        exact_right, exact_wrong = exact_right + len(exact & true), exact_wrong + len(exact - true)
    assert exact_right > 2000
    # all of them would mean that the search is no cheaper than the exact one
    assert 0.98 < hit / exact_right < 1
    assert right > 0.98 * exact_right
    assert wrong < 1.4 * exact_wrong + 10


@pytest.mark.parametrize("words", [1, 16])
def test_what_is_there_twice_is_no_ones_nearest(words):
    first, second, _ = scene(3)
    second = np.concatenate([first[:3], first[:2], second])
    search = ClusteredSearch.build(first, words, 16)
    alone = search.match(second, RATIO)[0]
    assert not np.isin(alone[:, 0], [0, 1]).any() and [2, 2] in alone.tolist()
    # without the test the first one counts
    assert search.match(second, 1.0)[0][:3].tolist() == [[0, 0], [1, 1], [2, 2]]


def test_more_probes_find_more():
    first, second, _ = scene(7)
    exact = as_set(exact_search(first).match(second, RATIO)[0])
    found = [
        len(exact & as_set(ClusteredSearch.build(first, 16, probes).match(second, RATIO)[0]))
        for probes in (1, 2, 4, 16)
    ]
    assert found[0] < found[1] <= found[2] <= found[3] == len(exact)


@pytest.mark.parametrize(("words", "probes"), [(16, 16), (16, 99)])
def test_probing_all_words_is_exact(words, probes):
    first, second, _ = scene(3)
    expected = exact_search(first).match(second, RATIO)
    for one, other in zip(
        expected, ClusteredSearch.build(first, words, probes).match(second, RATIO), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_every_descriptor_probes_its_own_word_and_the_mean_is_as_asked():
    first, _, _ = scene(5)
    search = ClusteredSearch.build(first, 16, 2.5)
    words = np.repeat(np.arange(16), np.diff(search.offsets))
    squared = ((first[:, None].astype(float) - search.centers) ** 2).sum(axis=2)
    owners = np.empty(len(words), int)
    owners[search.by_row] = search.owners
    assert {(row, word) for row, word in enumerate(squared.argmin(axis=1))} <= set(
        zip(owners.tolist(), words.tolist(), strict=True)
    )
    assert 2.5 * len(first) <= len(words) < 2.51 * len(first)
    assert len(np.unique(np.bincount(owners))) > 2
    np.testing.assert_array_equal(search.vectors[:, :-2], first[owners])


def test_the_size_of_the_blocks_does_not_matter(monkeypatch):
    first, second, _ = scene(2)
    expected = ClusteredSearch.build(first, 16, 3).match(second, RATIO)
    for products in (1, 1000, 7777):
        monkeypatch.setattr(clustered, "PRODUCTS_AT_ONCE", products)
        for one, other in zip(
            expected, ClusteredSearch.build(first, 16, 3).match(second, RATIO), strict=True
        ):
            np.testing.assert_array_equal(one, other)


def test_the_order_of_summation_does_not_matter():
    first, second, _ = scene(2)
    order = np.random.default_rng(1).permutation(128)
    plain = ClusteredSearch.build(first, 16, 3)
    shuffled = ClusteredSearch.build(first[:, order], 16, 3)
    np.testing.assert_array_equal(plain.centers[:, order], shuffled.centers)
    for one, other in zip(plain.match(second, RATIO), shuffled.match(second[:, order], RATIO), strict=True):
        np.testing.assert_array_equal(one, other)


def test_largest_descriptors_stay_exact():
    rng = np.random.default_rng(0)
    first = rng.integers(200, 256, (1500, 128)).astype(np.uint8)
    second = np.where(rng.random((1500, 128)) < 0.1, rng.integers(200, 256, (1500, 128)), first)
    second = second.astype(np.uint8)
    for matches, _ in (
        exact_search(first).match(second, RATIO),
        ClusteredSearch.build(first, 16, 16).match(second, RATIO),
    ):
        np.testing.assert_array_equal(matches, np.column_stack([np.arange(1500)] * 2))


def test_few_words_for_few_descriptors():
    first, second, _ = scene(6)
    assert len(ClusteredSearch.build(first[:200], 32, 3).centers) == 3
    expected = exact_search(first[:200]).match(second, RATIO)
    for one, other in zip(
        expected, ClusteredSearch.build(first[:200], 32, 3).match(second, RATIO), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_no_second_nearest_no_match():
    near, far = np.zeros((640, 128), np.uint8), np.full((640, 128), 200, np.uint8)
    rng = np.random.default_rng(3)
    first = np.concatenate([near, far]) + rng.integers(0, 20, (1280, 128)).astype(np.uint8)
    search = ClusteredSearch.build(first, 2, 1)
    # one descriptor in the first group, many in the other
    second = np.concatenate([first[:1], first[900:]])
    matches, _ = search.match(second, 1.0)
    assert 0 not in matches[:, 0] and len(matches) == 380
    assert search.match(first[:2], RATIO)[0].tolist() == [[0, 0], [1, 1]]


def test_codebook_of_integers_is_of_integers_and_of_floats_is_not():
    first, _, _ = scene(8)
    whole = learn_small_codebook(first, 16)
    real = learn_small_codebook((first / 512).astype(np.float16), 16)
    np.testing.assert_array_equal(whole, np.rint(whole))
    np.testing.assert_allclose(whole, real * 512, atol=20)
    assert len(np.unique(whole, axis=0)) == 16 and (real != np.rint(real)).any()


def test_codebook_of_equal_descriptors():
    same = np.full((2000, 128), 7, np.uint8)
    np.testing.assert_array_equal(learn_small_codebook(same, 16), np.full((16, 128), 7))
    search = ClusteredSearch.build(same, 16, 3)
    assert len(search.match(same, RATIO)[0]) <= 1
