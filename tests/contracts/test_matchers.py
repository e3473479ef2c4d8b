"""What every matcher of two images must do."""

import numpy as np
import pytest

from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.sift import rootsift
from snakesfm.matching.matcher import MATCHERS, create_matcher


def keypoints(descriptors, seed=0):
    rng = np.random.default_rng(seed)
    count = len(descriptors)
    return KeypointSet(
        rng.uniform(0, 500, (count, 2)).astype(np.float32),
        descriptors,
        np.ones(count, np.float32),
        np.full(count, 3, np.float32),
        np.zeros(count, np.float32),
    )


def histograms(count, seed):
    rng = np.random.default_rng(seed)
    return rng.exponential(size=(count, 128)).astype(np.float32) ** 2


class MatcherContract:
    """Inherit and set ``method``."""

    method = ""

    @pytest.fixture
    def matcher(self):
        return create_matcher(self.method)

    def test_is_registered(self):
        assert self.method in MATCHERS

    def test_finds_a_permutation(self, matcher):
        descriptors = rootsift(histograms(700, 1))
        order = np.random.default_rng(2).permutation(700)
        matches, scores = matcher.match(keypoints(descriptors), keypoints(descriptors[order]))
        np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])
        assert len(matches) == 700
        assert matches.dtype == np.int32 and scores.dtype == np.float32

    def test_finds_noisy_partners_among_others(self, matcher):
        shared, noise = histograms(300, 1), histograms(300, 5) * 0.1
        first = rootsift(np.concatenate([shared, histograms(200, 2)]))
        second = rootsift(np.concatenate([histograms(250, 3), shared + noise]))
        matches, scores = matcher.match(keypoints(first), keypoints(second))
        right = matches[:, 1] == matches[:, 0] + 250
        assert right.mean() > 0.97 and right.sum() > 280
        assert ((scores >= 0) & (scores <= 1)).all()
        assert len(np.unique(matches[:, 0])) == len(matches) == len(np.unique(matches[:, 1]))

    def test_unrelated_images_hardly_match(self, matcher):
        matches, _ = matcher.match(
            keypoints(rootsift(histograms(600, 1))), keypoints(rootsift(histograms(600, 2)))
        )
        assert len(matches) < 12

    @pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 50), (50, 0), (1, 1), (1, 50), (50, 1)])
    def test_few_or_no_keypoints(self, matcher, first, second):
        matches, scores = matcher.match(
            keypoints(rootsift(histograms(first, 1))), keypoints(rootsift(histograms(second, 2)))
        )
        assert matches.shape == (len(scores), 2) and len(scores) <= min(first, second)
        assert matches.dtype == np.int32 and scores.dtype == np.float32

    def test_equal_descriptors_stay_one_to_one(self, matcher):
        same = np.repeat(rootsift(histograms(1, 1)), 40, axis=0)
        matches, _ = matcher.match(keypoints(same), keypoints(same))
        assert len(np.unique(matches[:, 0])) == len(matches) == len(np.unique(matches[:, 1]))

    def test_is_deterministic(self, matcher):
        first, second = keypoints(rootsift(histograms(400, 1))), keypoints(rootsift(histograms(500, 1)))
        for expected, actual in zip(
            matcher.match(first, second), matcher.match(first, second), strict=True
        ):
            np.testing.assert_array_equal(expected, actual)


class TestMutualRatio(MatcherContract):
    method = "mutual_ratio"

    def test_agrees_with_the_definition(self):
        rng = np.random.default_rng(4)
        first = rng.integers(0, 60, (613, 128)).astype(np.uint8)
        second = np.clip(first[rng.permutation(613)[:402]] + rng.integers(-9, 10, (402, 128)), 0, 255)
        distance = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
        ordered = np.sort(distance, axis=1)
        nearest = distance.argmin(axis=1)
        good = (ordered[:, 0] <= 0.8 * ordered[:, 1]) & (distance.argmin(axis=0)[nearest] == np.arange(613))
        matches, scores = create_matcher("mutual_ratio", max_ratio=0.8).match(
            keypoints(first), keypoints(second.astype(np.uint8))
        )
        np.testing.assert_array_equal(matches[:, 0], np.flatnonzero(good))
        np.testing.assert_array_equal(matches[:, 1], nearest[good])
        np.testing.assert_allclose(scores, 1 - (ordered[:, 0] / ordered[:, 1])[good], atol=1e-6)

    def test_half_floats_are_matched_too(self):
        vectors = np.random.default_rng(1).normal(size=(300, 256))
        vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)
        matches, scores = create_matcher("mutual_ratio").match(keypoints(vectors), keypoints(vectors[::-1]))
        np.testing.assert_array_equal(matches[:, 1], 299 - matches[:, 0])
        assert len(matches) == 300 and (scores > 0.9).all()

    def test_a_stricter_ratio_keeps_a_subset(self):
        first = keypoints(rootsift(histograms(300, 1)))
        second = keypoints(rootsift(histograms(300, 1) + histograms(300, 9)))
        found = [
            {
                tuple(match)
                for match in create_matcher("mutual_ratio", max_ratio=ratio).match(first, second)[0]
            }
            for ratio in (0.7, 0.8, 0.9, 1.0)
        ]
        assert found[0] < found[1] < found[2] < found[3]
