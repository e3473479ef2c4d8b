"""What every matcher of two images must do."""

from typing import Any, ClassVar

import numpy as np
import pytest

from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.sift import rootsift
from snakesfm.matching.matcher import MATCHERS


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
    """Inherit and set ``method``, and ``options`` where there are several ways to run it."""

    method = ""
    options: ClassVar[dict[str, Any]] = {}

    @pytest.fixture
    def match(self):
        matcher = MATCHERS[self.method](**self.options)
        return lambda first, second: matcher.match(matcher.prepare(first), matcher.prepare_second(second))

    def test_is_registered(self):
        assert self.method in MATCHERS

    def test_finds_a_permutation(self, match):
        descriptors = rootsift(histograms(700, 1))
        order = np.random.default_rng(2).permutation(700)
        matches, scores = match(keypoints(descriptors), keypoints(descriptors[order]))
        np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])
        assert len(matches) == 700
        assert matches.dtype == np.int32 and scores.dtype == np.float32

    def test_finds_noisy_partners_among_others(self, match):
        shared, noise = histograms(300, 1), histograms(300, 5) * 0.1
        first = rootsift(np.concatenate([shared, histograms(200, 2)]))
        second = rootsift(np.concatenate([histograms(250, 3), shared + noise]))
        matches, scores = match(keypoints(first), keypoints(second))
        right = matches[:, 1] == matches[:, 0] + 250
        assert right.mean() > 0.97 and right.sum() > 280
        assert ((scores >= 0) & (scores <= 1)).all()
        assert len(np.unique(matches[:, 0])) == len(matches) == len(np.unique(matches[:, 1]))

    def test_unrelated_images_hardly_match(self, match):
        matches, _ = match(keypoints(rootsift(histograms(600, 1))), keypoints(rootsift(histograms(600, 2))))
        assert len(matches) < 12

    @pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 50), (50, 0), (1, 1), (1, 50), (50, 1)])
    def test_few_or_no_keypoints(self, match, first, second):
        matches, scores = match(
            keypoints(rootsift(histograms(first, 1))), keypoints(rootsift(histograms(second, 2)))
        )
        assert matches.shape == (len(scores), 2) and len(scores) <= min(first, second)
        assert matches.dtype == np.int32 and scores.dtype == np.float32

    def test_equal_descriptors_stay_one_to_one(self, match):
        same = np.repeat(rootsift(histograms(1, 1)), 40, axis=0)
        matches, _ = match(keypoints(same), keypoints(same))
        assert len(np.unique(matches[:, 0])) == len(matches) == len(np.unique(matches[:, 1]))

    def test_a_prepared_image_serves_any_number_of_pairs(self):
        matcher = MATCHERS[self.method](**self.options)
        images = [keypoints(rootsift(histograms(count, 1))) for count in (500, 300, 700, 400)]
        prepared = matcher.prepare(images[0])
        for second in (*images, *images[::-1]):
            expected = matcher.match(matcher.prepare(images[0]), matcher.prepare_second(second))
            for one, other in zip(
                expected, matcher.match(prepared, matcher.prepare_second(second)), strict=True
            ):
                np.testing.assert_array_equal(one, other)

    def test_is_deterministic(self, match):
        first, second = keypoints(rootsift(histograms(400, 1))), keypoints(rootsift(histograms(500, 1)))
        for expected, actual in zip(match(first, second), match(first, second), strict=True):
            np.testing.assert_array_equal(expected, actual)


class MutualRatioContract(MatcherContract):
    method = "mutual_ratio"

    def test_half_floats_are_matched_too(self, match):
        vectors = np.random.default_rng(1).normal(size=(300, 256))
        vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)
        matches, scores = match(keypoints(vectors), keypoints(vectors[::-1]))
        np.testing.assert_array_equal(matches[:, 1], 299 - matches[:, 0])
        assert len(matches) == 300 and (scores > 0.9).all()

    def test_a_stricter_ratio_keeps_a_subset(self):
        first = keypoints(rootsift(histograms(300, 1)))
        second = keypoints(rootsift(histograms(300, 1) + histograms(300, 9)))
        found = []
        for ratio in (0.7, 0.8, 0.9, 1.0):
            matcher = MATCHERS["mutual_ratio"](**self.options, max_ratio=ratio)
            found.append(
                set(
                    map(
                        tuple,
                        matcher.match(matcher.prepare(first), matcher.prepare_second(second))[0].tolist(),
                    )
                )
            )
        assert found[0] < found[1] < found[2] < found[3]


class TestExactMutualRatio(MutualRatioContract):
    options: ClassVar = {"search": "exact"}

    def test_agrees_with_the_definition(self):
        rng = np.random.default_rng(4)
        first = rng.integers(0, 60, (613, 128)).astype(np.uint8)
        second = np.clip(first[rng.permutation(613)[:402]] + rng.integers(-9, 10, (402, 128)), 0, 255)
        distance = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
        ordered = np.sort(distance, axis=1)
        nearest = distance.argmin(axis=1)
        good = (ordered[:, 0] <= 0.8 * ordered[:, 1]) & (distance.argmin(axis=0)[nearest] == np.arange(613))
        matcher = MATCHERS["mutual_ratio"](search="exact", max_ratio=0.8)
        matches, scores = matcher.match(
            matcher.prepare(keypoints(first)), matcher.prepare_second(keypoints(second.astype(np.uint8)))
        )
        np.testing.assert_array_equal(matches[:, 0], np.flatnonzero(good))
        np.testing.assert_array_equal(matches[:, 1], nearest[good])
        np.testing.assert_allclose(scores, 1 - (ordered[:, 0] / ordered[:, 1])[good], atol=1e-6)


class TestClusteredMutualRatio(MutualRatioContract):
    options: ClassVar = {"search": "clustered"}


class TestClusteredMutualRatioOfManyWords(MutualRatioContract):
    options: ClassVar = {"search": "clustered", "words": 256, "probes": 4.5}
