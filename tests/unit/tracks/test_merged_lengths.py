"""Track lengths with and without merging."""

import itertools
import tracemalloc

import numpy as np
import pytest

from snakesfm.grouping import components_of, offsets_of
from snakesfm.tracks.merged import compare_track_lengths, describe_lengths


def test_merging_joins_what_every_pair_finds_at_another_place():
    rng = np.random.default_rng(0)
    images, points = 5, 40
    keypoints = [np.mgrid[0:400:10, 0:1].reshape(2, -1).T.astype(np.float32) for _ in range(images)]
    pairs = np.array(list(itertools.combinations(range(images), 2)))
    rows = np.arange(points, dtype=np.int32)
    matches = np.tile(np.column_stack([rows, rows]), (len(pairs), 1))
    offsets = np.arange(len(pairs) + 1) * points
    found = {}
    for i, j in pairs.tolist():
        places = np.hstack([keypoints[i], keypoints[j]])
        wrong = np.array([[0, 0, 200, 0]])
        found[i, j] = np.vstack([places + rng.uniform(-1, 1, places.shape), wrong]).astype(np.float32)
    unmerged, merged = compare_track_lengths(keypoints, pairs, offsets, matches, lambda i, j: found[i, j])
    np.testing.assert_array_equal(unmerged, [0, 0, points * len(pairs)])
    np.testing.assert_array_equal(merged, [0, 0, 0, 0, 0, points])
    assert describe_lengths(unmerged) == "400 tracks of 2.00 images on average, 100 % in two"
    assert describe_lengths(merged) == "40 tracks of 5.00 images on average, 0 % in two"


def test_places_that_pairs_share_join_without_merging():
    keypoints = [np.array([[5, 5]], np.float32)] * 3
    pairs = np.array([[0, 1], [0, 2]])
    found = {(0, 1): np.array([[5, 5, 6, 5]], np.float32), (0, 2): np.array([[5, 5, 4, 5]], np.float32)}
    unmerged, merged = compare_track_lengths(
        keypoints, pairs, np.array([0, 1, 2]), np.zeros((2, 2), np.int32), lambda i, j: found[i, j]
    )
    np.testing.assert_array_equal(unmerged, [0, 0, 0, 1])
    np.testing.assert_array_equal(merged, [0, 0, 0, 1])


def test_no_pairs_have_no_tracks():
    unmerged, merged = compare_track_lengths(
        [], np.zeros((0, 2), int), np.zeros(1, int), np.zeros((0, 2), int), lambda i, j: np.zeros((0, 4))
    )
    assert len(unmerged) == len(merged) == 0
    assert describe_lengths(unmerged) == "no tracks"


def plain_lengths(ends):
    """Lengths of the tracks of matches (M,2,3), whose ends are an image and two coordinates."""
    distinct, flat = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    labels = components_of(len(distinct), flat.reshape(-1, 2))
    seen = np.unique(np.column_stack([labels, distinct[:, 0]]), axis=0)[:, 0].astype(int)
    return np.bincount(np.bincount(seen), minlength=3)


def matches_among(images, keypoint_count, match_count, seed):
    """Keypoints on a grid around zero, random matches of all pairs, and where pairs found them."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[-400:400:10, -20:30:10].reshape(2, -1).T[:keypoint_count].astype(np.float32)
    pairs = np.array(list(itertools.combinations(range(images), 2)))
    matches, found = [], {}
    for i, j in pairs.tolist():
        rows = np.stack([rng.permutation(keypoint_count)[:match_count] for _ in range(2)], axis=1)
        # of few places, some with a zero that has a sign
        places = np.hstack([grid[rows[:, 0]], grid[rows[:, 1]]]) + rng.integers(0, 2, (match_count, 4))
        found[i, j] = (places * rng.choice([-1, 1], places.shape) ** (places == 0)).astype(np.float32)
        matches.append(rows.astype(np.int32))
    return [grid] * images, pairs, offsets_of([len(m) for m in matches]), np.concatenate(matches), found


@pytest.mark.parametrize("seed", range(3))
def test_lengths_are_those_of_components_of_places(seed):
    keypoints, pairs, offsets, matches, found = matches_among(6, 300, 60, seed)
    unmerged, merged = compare_track_lengths(keypoints, pairs, offsets, matches, lambda i, j: found[i, j])
    images = np.repeat(pairs, np.diff(offsets), axis=0)[:, :, None]
    places = np.concatenate([found[i, j] for i, j in pairs.tolist()])
    assert (np.signbit(places) & (places == 0)).any()
    raw = np.concatenate([images, places.reshape(-1, 2, 2).astype(float)], axis=2)
    rows = np.concatenate([images, matches[:, :, None], 0 * images], axis=2)
    np.testing.assert_array_equal(unmerged, plain_lengths(raw))
    np.testing.assert_array_equal(merged, plain_lengths(rows))
    assert len(unmerged) > 3 and len(merged) > 3


def test_a_match_takes_little_memory():
    keypoints, pairs, offsets, matches, found = matches_among(30, 400, 400, 0)
    tracemalloc.start()
    compare_track_lengths(keypoints, pairs, offsets, matches, lambda i, j: found[i, j])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 80 < peak / len(matches) < 200
