"""The matchers that are networks, with their real weights, on the keypoints they were trained on."""

from typing import ClassVar

import cv2
import numpy as np
import pytest
from contracts.test_detectors import extract, shapes

from snakesfm.errors import ConfigError
from snakesfm.features.extraction import DETECTORS
from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.checkpoints import read_checkpoint
from snakesfm.matching.matcher import MATCHERS

# a view of the picture from elsewhere: turned a little, smaller and in perspective
VIEW = np.array([[0.9, -0.12, 30], [0.1, 0.92, -12], [1e-4, -2e-4, 1.0]])


class LearnedMatcherContract:
    """Inherit and set ``method`` and ``detector``."""

    method = ""
    detector = ""
    median_error_px = 1.2
    made: ClassVar[dict] = {}

    @pytest.fixture
    def matcher(self, weights):
        key = (self.method, self.detector)
        if key not in self.made:
            state = read_checkpoint(f"{self.detector}_{self.method}", weights, "fetch")
            self.made[key] = MATCHERS[self.method](detector=self.detector, min_score=0.1, state=state)
        return self.made[key]

    @pytest.fixture
    def images(self, weights):
        """Keypoints of a picture, of a view of it, and of another picture."""
        if self.detector not in self.made:
            detector = DETECTORS[self.detector](state=read_checkpoint(self.detector, weights, "fetch"))
            gray, _ = shapes(400, 300)
            # the homography maps coordinates whose first pixel's centre is (0, 0)
            pictures = [gray, cv2.warpPerspective(gray, VIEW, (400, 300)), shapes(400, 300, seed=9)[0]]
            self.made[self.detector] = [
                extract(detector, p, np.repeat(p[..., None], 3, axis=2), 250, 760) for p in pictures
            ]
        return self.made[self.detector]

    def test_is_registered(self):
        assert self.method in MATCHERS

    def test_finds_what_a_homography_maps(self, matcher, images):
        matches, scores = matcher.match(matcher.prepare(images[0]), matcher.prepare_second(images[1]))
        assert matches.dtype == np.int32 and scores.dtype == np.float32
        assert ((scores >= 0.1) & (scores <= 1)).all()
        assert (np.diff(matches[:, 0]) > 0).all() and len(np.unique(matches[:, 1])) == len(matches)
        start = np.column_stack([images[0].keypoints[matches[:, 0]] - 0.5, np.ones(len(matches))])
        mapped = start @ VIEW.T
        errors = np.linalg.norm(
            mapped[:, :2] / mapped[:, 2:] + 0.5 - images[1].keypoints[matches[:, 1]], axis=1
        )
        assert len(matches) > 50
        assert (errors < 4).mean() > 0.85
        assert 0.05 < np.median(errors) < self.median_error_px

    def test_unrelated_images_match_less(self, matcher, images):
        prepared = matcher.prepare(images[0])
        related, unrelated = (
            matcher.match(prepared, matcher.prepare_second(second))[0] for second in images[1:]
        )
        assert len(unrelated) < 0.5 * len(related)

    @pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 50), (50, 0), (1, 1), (1, 50), (50, 1)])
    def test_few_or_no_keypoints(self, matcher, images, first, second):
        parts = [images[0].take(np.arange(first)), images[1].take(np.arange(second))]
        matches, scores = matcher.match(matcher.prepare(parts[0]), matcher.prepare_second(parts[1]))
        assert matches.shape == (len(scores), 2) and len(scores) <= min(first, second)
        assert matches.dtype == np.int32 and scores.dtype == np.float32

    def test_a_pair_does_not_depend_on_the_pairs_before_it(self, matcher, images):
        prepared = matcher.prepare(images[0])
        second = matcher.prepare_second(images[1])
        expected = matcher.match(prepared, second)
        matcher.match(prepared, matcher.prepare_second(images[2]))
        for one, other in zip(expected, matcher.match(prepared, second), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_a_larger_copy_of_the_images_matches_alike(self, matcher, images):
        before, _ = matcher.match(matcher.prepare(images[0]), matcher.prepare_second(images[1]))
        larger = [points.scaled(3, 3) for points in images[:2]]
        after, _ = matcher.match(matcher.prepare(larger[0]), matcher.prepare_second(larger[1]))
        same = set(map(tuple, before.tolist())) & set(map(tuple, after.tolist()))
        assert len(same) > 0.95 * max(len(before), len(after))

    def test_random_weights_run_through(self, images):
        matcher = MATCHERS[self.method](detector=self.detector, min_score=0.0, state=None)
        matches, scores = matcher.match(matcher.prepare(images[0]), matcher.prepare_second(images[1]))
        assert matches.shape == (len(scores), 2)

    def test_descriptors_of_another_detector_are_refused(self, matcher):
        with pytest.raises(ConfigError, match=r"extract_features\.method"):
            matcher.prepare(KeypointSet.empty(32, np.float16))


class TestAlikedLightglue(LearnedMatcherContract):
    method = "lightglue"
    detector = "aliked"


class TestDiskLightglue(LearnedMatcherContract):
    method = "lightglue"
    detector = "disk"


class TestXfeatLighterglue(LearnedMatcherContract):
    method = "lightglue"
    detector = "xfeat"
    median_error_px = 1.8


def test_superglue_gives_in_a_batch_what_it_gives_alone_in_any_order():
    torch = pytest.importorskip("torch", reason="the extra 'deep' is not installed")
    pytest.importorskip("transformers", reason="the extra 'deep' is not installed")
    torch.manual_seed(0)
    matcher = MATCHERS["superglue"](detector="superpoint", min_score=0.0, state=None)
    counts = [(40, 25), (30, 40), (1, 40), (40, 40), (20, 20), (0, 5)]
    pairs = [
        tuple(
            matcher.prepare(TestSuperpointMatchersOfRandomWeights.points(count, 2 * row + side))
            for side, count in enumerate(pair)
        )
        for row, pair in enumerate(counts)
    ]
    apart = [matcher.match(*pair) for pair in pairs]
    assert [len(matches) > 5 for matches, _ in apart] == [True, True, False, True, True, False]
    for order in ([0, 1, 2, 3, 4, 5], [5, 3, 1, 4, 2, 0]):
        together = matcher.match_batch([pairs[row] for row in order])
        for row, (matches, scores) in zip(order, together, strict=True):
            np.testing.assert_array_equal(matches, apart[row][0])
            np.testing.assert_allclose(scores, apart[row][1], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("method", ["lightglue", "superglue"])
class TestSuperpointMatchersOfRandomWeights:
    """Their real weights are not to be had here: shapes, and what a pair depends on."""

    made: ClassVar[dict] = {}

    @pytest.fixture
    def matcher(self, method):
        pytest.importorskip("transformers", reason="the extra 'deep' is not installed")
        if method not in self.made:
            import torch

            torch.manual_seed(0)
            self.made[method] = MATCHERS[method](detector="superpoint", min_score=0.0, state=None)
        return self.made[method]

    @staticmethod
    def points(count, seed, size=(320, 240)):
        rng = np.random.default_rng(seed)
        vectors = rng.normal(size=(count, 256))
        return KeypointSet(
            (rng.uniform(size=(count, 2)) * size).astype(np.float32),
            (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16),
            rng.uniform(size=count).astype(np.float32),
            np.ones(count, np.float32),
            np.zeros(count, np.float32),
            size,
        )

    @pytest.mark.parametrize("counts", [(0, 5), (5, 0), (1, 5), (30, 50), (50, 30), (40, 40)])
    def test_matches_are_one_to_one(self, matcher, counts):
        first, second = self.points(counts[0], 1), self.points(counts[1], 2, (200, 300))
        matches, scores = matcher.match(matcher.prepare(first), matcher.prepare_second(second))
        assert matches.shape == (len(scores), 2)
        assert matches.dtype == np.int32 and scores.dtype == np.float32
        assert min(counts) < 2 or len(matches) > 0
        assert (np.diff(matches[:, 0]) > 0).all() and len(np.unique(matches[:, 1])) == len(matches)
        assert len(matches) == 0 or (matches.max(axis=0) < counts).all()
        assert ((scores >= 0) & (scores <= 1)).all()

    def test_images_of_any_scale_match_alike(self, matcher):
        first, second = self.points(40, 1), self.points(40, 2)
        before = matcher.match(matcher.prepare(first), matcher.prepare_second(second))
        after = matcher.match(matcher.prepare(first.scaled(4, 4)), matcher.prepare_second(second))
        np.testing.assert_array_equal(before[0], after[0])
        np.testing.assert_allclose(before[1], after[1], rtol=1e-3)

    def test_padding_changes_nothing(self, matcher):
        first, second = self.points(40, 1), self.points(25, 2)
        matches, scores = matcher.match(matcher.prepare(first), matcher.prepare_second(second))
        turned = matcher.match(matcher.prepare(second), matcher.prepare_second(first))
        order = np.argsort(turned[0][:, 1])
        np.testing.assert_array_equal(matches, turned[0][order][:, ::-1])
        np.testing.assert_allclose(scores, turned[1][order], rtol=1e-3, atol=1e-7)

    def test_descriptors_of_another_detector_are_refused(self, matcher):
        with pytest.raises(ConfigError, match=r"extract_features\.method"):
            matcher.prepare(KeypointSet.empty(128, np.float16))
