"""Track lengths with and without merging."""

import itertools

import numpy as np

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
