"""Keypoints out of coordinates that were found pair by pair."""

import numpy as np
import pytest

from snakesfm.matching.merging import MergedKeypoints, index_coordinates, merge_coordinates


def scattered(count=3000, seed=0):
    rng = np.random.default_rng(seed)
    places = np.round(rng.uniform(0, 200, (count, 2)) * 4) / 4
    return places.astype(np.float32), (rng.integers(1, 30, count) / 30).astype(np.float32)


def test_agrees_with_the_definition():
    places, scores = scattered(600)
    kept = []
    for row in np.lexsort((places[:, 1], places[:, 0], -scores)):
        if all(np.linalg.norm(places[row] - places[other]) > 3 for other in kept):
            kept.append(row)
    keypoints, found = merge_coordinates(places, scores, 3.0)
    np.testing.assert_array_equal(keypoints, places[kept])
    np.testing.assert_array_equal(found, scores[kept])


def test_the_order_and_repetitions_change_nothing():
    places, scores = scattered()
    expected = merge_coordinates(places, scores, 3.0)
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(places))
        order = np.concatenate([order, order[:500]])
        for one, other in zip(expected, merge_coordinates(places[order], scores[order], 3.0), strict=True):
            np.testing.assert_array_equal(one, other)


def test_keypoints_lie_apart_and_every_place_has_one_near():
    places, scores = scattered()
    keypoints, _ = merge_coordinates(places, scores, 3.0)
    apart = np.linalg.norm(keypoints[:, None] - keypoints[None], axis=2) + 1e9 * np.eye(len(keypoints))
    assert 3 < apart.min() < 3.5
    nearest = MergedKeypoints(keypoints).nearest(places, 3.0)
    assert (nearest >= 0).all()
    assert np.linalg.norm(keypoints[nearest] - places, axis=1).max() <= 3


def test_a_place_beyond_the_radius_has_no_keypoint():
    merged = MergedKeypoints(np.array([[10, 10]], np.float32))
    found = merged.nearest(np.array([[10, 12], [10, 13], [10, 13.01]], np.float32), 3.0)
    np.testing.assert_array_equal(found, [0, 0, -1])


@pytest.mark.parametrize("count", [0, 1])
def test_few_or_no_places(count):
    places, scores = scattered(count)
    keypoints, found = merge_coordinates(places, scores, 3.0)
    assert keypoints.shape == (count, 2) and found.shape == (count,)
    assert keypoints.dtype == np.float32 and found.dtype == np.float32
    matches, sure = index_coordinates(
        np.hstack([places, places]), scores, MergedKeypoints(keypoints), MergedKeypoints(keypoints), 3.0
    )
    assert matches.shape == (count, 2) and sure.shape == (count,) and matches.dtype == np.int32


def test_matches_are_one_to_one_and_the_surest_wins():
    first = MergedKeypoints(np.array([[10, 10], [30, 10]], np.float32))
    second = MergedKeypoints(np.array([[50, 50], [70, 50], [90, 50]], np.float32))
    coordinates = np.array(
        [[11, 10, 50, 51], [10, 11, 71, 50], [30, 10, 70, 51], [31, 10, 70, 50], [60, 10, 90, 50]],
        np.float32,
    )
    scores = np.array([0.9, 0.8, 0.3, 0.4, 1.0], np.float32)
    matches, sure = index_coordinates(coordinates, scores, first, second, 3.0)
    np.testing.assert_array_equal(matches, [[0, 0], [1, 1]])
    np.testing.assert_array_equal(sure, scores[[0, 3]])
