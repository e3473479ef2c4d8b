"""Pairs that share nothing are left after a look at their largest keypoints."""

import dataclasses

import numpy as np
import pytest

from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.sift import rootsift
from snakesfm.matching.matcher import create_matcher
from snakesfm.matching.preview import largest_keypoints, likeness


def histograms(count, seed):
    return np.random.default_rng(seed).exponential(size=(count, 128)).astype(np.float32) ** 2


def image(descriptors, seed=0):
    """Keypoints with scales in random order."""
    rng = np.random.default_rng(seed)
    count = len(descriptors)
    places = rng.uniform(0, 500, (count, 2)).astype(np.float32)
    ones = np.ones(count, np.float32)
    return KeypointSet(places, rootsift(descriptors), ones, rng.permutation(count).astype(np.float32), ones)


def overlapping(count, shared, seed=0):
    """Two images of ``count`` keypoints that share some of theirs, with noise, at the same scales."""
    rng = np.random.default_rng(seed)
    common = histograms(shared, 1)
    noisy = common * rng.uniform(0.6, 1.4, common.shape).astype(np.float32)
    first = image(np.concatenate([common, histograms(count - shared, 2)]))
    second = image(np.concatenate([noisy, histograms(count - shared, 3)]))
    return first, dataclasses.replace(second, scales=first.scales)


def test_the_largest_are_chosen_and_few_keypoints_are_not_looked_at():
    points = image(histograms(60, 1))
    largest = largest_keypoints(points, 20)
    np.testing.assert_array_equal(largest, points.descriptors[np.argsort(points.scales)[::-1][:20]])
    assert largest_keypoints(points, 31) is None
    assert largest_keypoints(points, 30) is not None
    assert largest_keypoints(points, 0) is None


def test_equal_scales_are_taken_from_the_front():
    points = dataclasses.replace(image(histograms(60, 1)), scales=np.ones(60, np.float32))
    np.testing.assert_array_equal(largest_keypoints(points, 20), points.descriptors[:20])


def test_likeness_grows_with_what_is_shared():
    values = []
    for shared in (0, 100, 400, 1000):
        first, second = (largest_keypoints(points, 400) for points in overlapping(1000, shared))
        values.append(likeness(first, second))
    assert 0 < values[0] < 1.5
    assert values[1] > 4 * values[0] and values[2] > 2 * values[1] and values[3] > 1.5 * values[2]
    assert values[3] < 400


def test_likeness_of_equal_images_and_of_equal_descriptors_is_finite():
    some = rootsift(histograms(50, 1))
    assert likeness(some, some) == pytest.approx(50.0)
    assert likeness(some[:1].repeat(50, axis=0), some[:1].repeat(50, axis=0)) == 0.0


def test_likeness_is_the_same_in_both_directions_for_strangers_and_relatives():
    for shared in (0, 300):
        first, second = (largest_keypoints(points, 300) for points in overlapping(800, shared))
        assert 0.5 < likeness(first, second) / likeness(second, first) < 2.0


@pytest.mark.parametrize("shared", [150, 500])
def test_a_pair_that_overlaps_is_matched_as_without_a_preview(shared):
    first, second = overlapping(1000, shared)
    found = []
    for count in (0, 400):
        matcher = create_matcher("mutual_ratio", preview_keypoints=count)
        found.append(matcher.match(matcher.prepare(first), matcher.prepare_second(second)))
    assert len(found[0][0]) > 0.8 * shared
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_strangers_are_left_and_the_threshold_decides():
    first, second = image(histograms(1000, 1)), image(histograms(1000, 2))
    counts = {}
    for least in (0.0, 1.5):
        matcher = create_matcher("mutual_ratio", max_ratio=1.0, min_likeness=least)
        matches, scores = matcher.match(matcher.prepare(first), matcher.prepare_second(second))
        assert matches.shape == (len(scores), 2) and matches.dtype == np.int32
        counts[least] = len(matches)
    assert counts[0.0] > 100 and counts[1.5] == 0
