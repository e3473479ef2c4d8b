"""Orders, lists, similar images and the options of select_pairs."""

import numpy as np
import pytest

from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.errors import ConfigError
from snakesfm.image_names import natural_key
from snakesfm.retrieval.listed import listed_pairs
from snakesfm.retrieval.pairs import PairTable, choose_similar, sequential_pairs, similar_pairs
from snakesfm.retrieval.rounding import round_units


def test_natural_order_counts():
    names = [
        "img10.jpg",
        "img2.jpg",
        "IMG1.JPG",
        "a/img3.jpg",
        "img2b.jpg",
        "img02.jpg",
        "x²٣.png",
        "7.png",
    ]
    assert sorted(names, key=natural_key) == [
        "7.png",
        "a/img3.jpg",
        "IMG1.JPG",
        "img02.jpg",
        "img2.jpg",
        "img2b.jpg",
        "img10.jpg",
        "x²٣.png",
    ]


def test_sequence_follows_the_natural_order_of_names():
    names = sorted(f"img{k}.jpg" for k in range(1, 13))
    table = sequential_pairs(names, 2)
    steps = {abs(int(names[i][3:-4]) - int(names[j][3:-4])) for i, j in table.pairs}
    assert steps == {1, 2}
    assert len(table.pairs) == 11 + 10


def unit_vectors(count, seed=0, size=32, shift=0.3):
    vectors = np.random.default_rng(seed).normal(size=(count, size)) + shift
    return round_units(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@pytest.mark.parametrize("block_count", [1, 2, 7, 50])
def test_similar_pairs_do_not_depend_on_the_blocks(block_count):
    vectors = unit_vectors(50)
    vectors[7] = vectors[3]
    dealt = np.random.default_rng(block_count).integers(0, block_count, 50)
    blocks = [np.flatnonzero(dealt == block) for block in range(block_count)]
    table = similar_pairs(blocks, lambda block: vectors[blocks[block]], 4, 0.1)
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -1)
    expected = {
        tuple(sorted((i, int(j))))
        for i in range(50)
        for j in np.argsort(-similarity[i], kind="stable")[:4]
        if similarity[i, j] >= 0.1
    }
    assert {tuple(pair) for pair in table.pairs} == expected
    np.testing.assert_array_equal(table.similarities, similarity[tuple(table.pairs.T)])


# few steps per number and all of one sign is where the sums become largest
@pytest.mark.parametrize("shift", [0.0, 5.0])
def test_similarities_of_long_descriptors_are_exact_in_any_blocks(shift):
    vectors = unit_vectors(300, 4, 8448, shift)
    exact = np.einsum("id,jd->ij", vectors.astype(np.float64), vectors.astype(np.float64))
    for block_count in (1, 3, 23):
        blocks = np.array_split(np.random.default_rng(block_count).permutation(300), block_count)
        table = similar_pairs(blocks, lambda block, blocks=blocks: vectors[blocks[block]], 299, -1.0)
        assert len(table.pairs) > 20_000
        np.testing.assert_array_equal(table.similarities, exact[tuple(table.pairs.T)])


def test_blocks_that_are_held_are_not_read_again_and_change_nothing():
    vectors = unit_vectors(40)
    blocks = [np.arange(start, start + 8) for start in range(0, 40, 8)]
    counts, tables = [], []
    # one block at a time, two, and all
    for held_bytes in (0, 2 * (vectors[:8].nbytes + 8 * 40 * 4), 1 << 30):
        reads = []

        def read(block, reads=reads):
            reads.append(block)
            return vectors[blocks[block]]

        tables.append(similar_pairs(blocks, read, 3, 0.0, held_bytes))
        counts.append(len(reads))
    assert counts == [25, 15, 5]
    for table in tables[1:]:
        np.testing.assert_array_equal(table.pairs, tables[0].pairs)
        np.testing.assert_array_equal(table.similarities, tables[0].similarities)


def ring_vectors(count, lap, seed=0):
    """Descriptors of a slow video that goes round in laps: what is like by place, and more so by time."""
    rng = np.random.default_rng(seed)
    time = np.arange(count)[:, None] / 80.0
    place = 2 * np.pi * np.arange(count)[:, None] / lap
    ring = np.hstack([np.cos(place), np.sin(place)]) * lap / (2 * np.pi * 80.0)
    parts = []
    for where, share in ((ring, 0.6), (time, 0.4)):
        # random features of a Gaussian kernel of 80 images (Rahimi and Recht 2007)
        waves = where @ rng.normal(size=(where.shape[1], 1000)) + rng.uniform(0, 2 * np.pi, 1000)
        parts.append(np.cos(waves) * np.sqrt(share))
    vectors = np.hstack(parts) + rng.normal(size=(count, 2000)) * 0.1
    return round_units(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def test_the_second_lap_of_a_slow_video_is_found():
    count, lap = 1200, 600
    times = np.random.default_rng(1).permutation(count)
    vectors = ring_vectors(count, lap)[times]
    blocks = np.array_split(np.arange(count), 4)

    def find(**told):
        table = similar_pairs(blocks, lambda block: vectors[blocks[block]], 100, -1.0, **told)
        pairs = np.sort(times[table.pairs], axis=1)
        return pairs, np.abs(pairs[:, 1] - pairs[:, 0] - lap) <= 15

    # the first and last images of the video have fewer neighbours
    middle = np.arange(100, lap - 100)
    alone, closing = find()
    assert not np.isin(middle, alone[closing]).any()
    pairs, closing = find(order=np.argsort(times), look_ahead=10)
    assert np.isin(middle, pairs[closing, 0]).mean() > 0.95
    assert len(pairs) < 100 * count
    near = [set(map(tuple, some[some[:, 1] - some[:, 0] < 20].tolist())) for some in (alone, pairs)]
    # as the most similar ones were
    assert near[0] == near[1] and len(near[0]) > 18 * count


def test_in_an_order_half_of_the_images_are_larger_than_their_neighbours():
    similarities = np.array([9, 8, 7, 6, -np.inf, 1, 2, 0, 3, -np.inf, -np.inf, -np.inf, 4, 0], np.float32)
    order = np.arange(len(similarities))

    def chosen(top_k, look_ahead, order=order):
        return choose_similar(similarities, top_k, order, look_ahead).tolist()

    assert chosen(6, 1, None) == [0, 1, 2, 3, 12, 8]
    # the largest of 11 .. 13 and of 7 .. 9 and of 5 .. 7
    assert chosen(6, 1) == [0, 1, 2, 12, 8, 6] and chosen(5, 2) == [0, 1, 2, 12, 8]
    assert chosen(7, 2) == [0, 1, 2, 3, 12, 8, 6]
    # where there are no more of them the next most similar fill up, and who is never chosen does not
    assert chosen(8, 1) == [0, 1, 2, 3, 12, 8, 6, 5] and len(chosen(14, 1)) == 10
    assert chosen(2, 1) == [0, 12] and chosen(1, 1) == [0]


def test_images_without_features_resemble_none():
    vectors = unit_vectors(6)
    vectors[2] = 0
    table = similar_pairs([np.arange(6)], lambda block: vectors, 5, -1.0)
    assert 2 not in table.pairs
    # nor do they take the place of one that has
    assert len(table.pairs) == 5 * 4 / 2


def test_images_choose_partners_of_negative_similarity():
    # three directions of a plane: all dot products but an image's own are -1/2
    angles = 2 * np.pi * np.arange(3) / 3
    vectors = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    vectors = round_units(np.vstack([vectors, np.zeros(3), [0, 0, 1], [0, 0, -1]]))
    both_blocks = [np.arange(3), np.arange(3, 6)]

    def pairs(top_k, min_score):
        table = similar_pairs(both_blocks, lambda block: vectors[both_blocks[block]], top_k, min_score)
        return table.pairs.tolist()

    plane = [[0, 1], [0, 2], [1, 2]]
    across = [[i, j] for i in range(3) for j in (4, 5)]
    assert pairs(5, -1.0) == sorted([*plane, *across, [4, 5]])
    assert pairs(5, -0.75) == sorted([*plane, *across])
    assert pairs(5, 0.0) == across
    # the most similar come first, whatever their sign, and image 3 has nothing
    assert pairs(1, -1.0) == [[0, 4], [0, 5], [1, 4], [2, 4]]


def test_opposite_descriptors_are_no_less_than_the_least_similarity():
    # a vocabulary learned on two images puts their residuals on opposite sides
    vector = np.array([0.5004, 0.5004, 0.5, 0.5])
    vectors = round_units(np.vstack([vector, -vector]))
    assert (vectors @ vectors.T)[0, 1] < -1
    assert similar_pairs([np.arange(2)], lambda block: vectors, 1, -1.0).pairs.tolist() == [[0, 1]]


def test_union_joins_reasons_and_keeps_similarities():
    first = PairTable.of(np.array([[0, 1], [1, 2]]), "sequential")
    second = PairTable.of(np.array([[2, 1], [0, 3]]), "retrieved", np.array([0.5, 0.25], np.float32))
    table = first.union(second)
    assert table.pairs.tolist() == [[0, 1], [0, 3], [1, 2]]
    assert table.reason_texts() == ["sequential", "retrieved", "sequential+retrieved"]
    np.testing.assert_array_equal(table.similarities, np.array([np.nan, 0.25, 0.5], np.float32))


def test_listed_names_may_hold_spaces():
    names = ["a", "a b", "b c.jpg", "c.jpg", "ü/#{x} 1.JPG", "# d"]
    lines = [
        "# a comment",
        "",
        "a b b c.jpg",
        "a b\tc.jpg",
        "  ü/#{x} 1.JPG   a\r",
        "# d a",
    ]
    table, skipped = listed_pairs(lines, names, [], "pairs.txt")
    # 'a b b c.jpg' is 'a b' + 'b c.jpg', for no image is called 'a b b'
    assert table.pairs.tolist() == [[0, 4], [0, 5], [1, 2], [1, 3]]
    assert skipped == 0


@pytest.mark.parametrize("space", ["\u00a0", "\u2003", "\u3000", "\v", " \u00a0 "])
def test_listed_names_may_be_parted_by_any_space(space):
    names = ["a.jpg", "b\u00a0c.jpg"]
    table, _ = listed_pairs([f"a.jpg{space}b\u00a0c.jpg"], names, [], "pairs.txt")
    assert table.pairs.tolist() == [[0, 1]]
    with pytest.raises(ConfigError, match=r"pairs\.txt:1: there is no image 'd\.jpg'"):
        listed_pairs([f"a.jpg{space}d.jpg"], names, [], "pairs.txt")


def test_listed_pairs_with_a_refused_image_are_skipped():
    table, skipped = listed_pairs(["a bad", "a b"], ["a", "b"], ["bad"], "pairs.txt")
    assert table.pairs.tolist() == [[0, 1]] and skipped == 1


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("img1.jpg img22.jpg", ["pairs.txt:2", "'img22.jpg'", "did you mean 'img2.jpg'"]),
        ("img1.jpg", ["pairs.txt:2", "not a pair"]),
        ("img1.jpg img2.jpg extra", ["pairs.txt:2", "tab"]),
        ("img1.jpg\tzzz", ["pairs.txt:2", "'zzz'", "relative to the image folder"]),
    ],
)
def test_a_wrong_line_is_named(line, words):
    with pytest.raises(ConfigError) as error:
        listed_pairs(["img1.jpg img2.jpg", line], ["img1.jpg", "img2.jpg"], [], "pairs.txt")
    assert all(word in str(error.value) for word in words), str(error.value)


def test_auto_is_resolved_by_the_number_of_images():
    options = SelectPairsOptions()
    most = options.resolve(2).exhaustive_up_to
    assert options.resolve(most).method == "exhaustive"
    assert options.resolve(most + 1).method == "sequential+retrieval"
    assert options.resolve(most, "pairs.txt").method == "listed"
    assert options.resolve(most).top_k == 100 and options.resolve(most).looks_at_pairs
    assert not options.resolve(2).needs_descriptors
    assert options.resolve(most + 1).needs_descriptors
    kept = SelectPairsOptions(method="retrieval", top_k=7).resolve(10)
    assert (kept.method, kept.top_k) == ("retrieval", 7)
    assert kept.resolve(1000) == kept
    assert most == 1000 and SelectPairsOptions(exhaustive_up_to=7).resolve(8).method != "exhaustive"
    with pytest.raises(ValueError, match="resolve"):
        _ = options.needs_descriptors


@pytest.mark.parametrize(
    ("changes", "detector"),
    [({}, "aliked"), ({}, ""), ({"preview_keypoints": 0}, "sift"), ({"method": "retrieval"}, "disk")],
)
def test_without_a_look_fewer_pairs_are_proposed(changes, detector):
    options = SelectPairsOptions(**changes)
    few, many = options.resolve(499, detector=detector), options.resolve(501, detector=detector)
    assert not few.looks_at_pairs and not many.looks_at_pairs
    assert (few.top_k, many.top_k) == (15, 30)
    assert "retrieval" in many.method


@pytest.mark.parametrize("method", ["sequential", "listed"])
def test_what_the_user_orders_is_not_looked_at(method):
    assert not SelectPairsOptions(method=method).resolve(5, "pairs.txt").looks_at_pairs
