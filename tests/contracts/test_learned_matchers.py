"""The matchers that are networks, with their real weights, on the keypoints they were trained on."""

from typing import ClassVar

import cv2
import numpy as np
import pytest
from contracts.test_detectors import extract, shapes
from contracts.test_matchers import MatcherContract, check_matches
from extras import import_extra

from snakesfm.errors import ConfigError
from snakesfm.features.extraction import DETECTORS
from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.checkpoints import read_checkpoint
from snakesfm.matching.matcher import MATCHERS

# a view of the picture from elsewhere: turned a little, smaller and in perspective
VIEW = np.array([[0.9, -0.12, 30], [0.1, 0.92, -12], [1e-4, -2e-4, 1.0]])


class LearnedMatcherContract(MatcherContract):
    """Inherit and set ``method`` and ``detector``."""

    fewest = 40
    # the sums of a network may differ with where its arrays lie in memory
    same_tolerance = 1e-5
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

    def test_finds_what_a_homography_maps(self, matcher, images):
        matches, scores = self.match(matcher, *images[:2])
        assert (scores >= 0.1).all()
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

    def test_a_larger_copy_of_the_images_matches_alike(self, matcher, images):
        before, _ = self.match(matcher, *images[:2])
        after, _ = self.match(matcher, *[points.scaled(3, 3) for points in images[:2]])
        same = set(map(tuple, before.tolist())) & set(map(tuple, after.tolist()))
        assert len(same) > 0.95 * max(len(before), len(after))

    def test_random_weights_run_through(self, images):
        matcher = MATCHERS[self.method](detector=self.detector, min_score=0.0, state=None)
        matches, scores = self.match(matcher, *images[:2])
        check_matches(matches, scores, len(images[0]), len(images[1]))

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


class SuperpointMatcherContract(MatcherContract):
    """Inherit and set ``method``; real weights are not to be had here: shapes, and what a pair depends on."""

    detector = "superpoint"
    same_tolerance = 1e-5
    made: ClassVar[dict] = {}

    @pytest.fixture
    def matcher(self):
        import_extra("transformers")
        if self.method not in self.made:
            import torch

            torch.manual_seed(0)
            self.made[self.method] = MATCHERS[self.method](
                detector=self.detector, min_score=0.0, state=None
            )
        return self.made[self.method]

    @pytest.fixture
    def images(self):
        return [self.points(60, 1), self.points(50, 2, (200, 300)), self.points(30, 3)]

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

    def test_images_of_any_scale_match_alike(self, matcher):
        first, second = self.points(40, 1), self.points(40, 2)
        before = self.match(matcher, first, second)
        after = self.match(matcher, first.scaled(4, 4), second)
        assert len(before[0]) > 0
        np.testing.assert_array_equal(before[0], after[0])
        np.testing.assert_allclose(before[1], after[1], rtol=1e-3)

    def test_padding_changes_nothing(self, matcher):
        first, second = self.points(40, 1), self.points(25, 2)
        matches, scores = self.match(matcher, first, second)
        turned = self.match(matcher, second, first)
        order = np.argsort(turned[0][:, 1])
        np.testing.assert_array_equal(matches, turned[0][order][:, ::-1])
        np.testing.assert_allclose(scores, turned[1][order], rtol=1e-3, atol=1e-7)

    def test_descriptors_of_another_detector_are_refused(self, matcher):
        with pytest.raises(ConfigError, match=r"extract_features\.method"):
            matcher.prepare(KeypointSet.empty(128, np.float16))


class TestSuperpointLightglue(SuperpointMatcherContract):
    method = "lightglue"


class TestSuperpointSuperglue(SuperpointMatcherContract):
    method = "superglue"

    def test_a_batch_gives_what_pairs_alone_give_in_any_order(self, matcher):
        counts = [(40, 25), (30, 40), (1, 40), (40, 40), (20, 20), (0, 5)]
        pairs = [
            tuple(matcher.prepare(self.points(count, 2 * row + side)) for side, count in enumerate(pair))
            for row, pair in enumerate(counts)
        ]
        apart = [matcher.match(*pair) for pair in pairs]
        assert [len(matches) > 5 for matches, _ in apart] == [True, True, False, True, True, False]
        for order in ([0, 1, 2, 3, 4, 5], [5, 3, 1, 4, 2, 0]):
            together = matcher.match_batch([pairs[row] for row in order])
            for row, (matches, scores) in zip(order, together, strict=True):
                np.testing.assert_array_equal(matches, apart[row][0])
                np.testing.assert_allclose(scores, apart[row][1], rtol=1e-3, atol=1e-6)
