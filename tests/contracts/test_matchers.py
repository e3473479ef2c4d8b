"""What every matcher of two images must do."""

from dataclasses import replace
from typing import Any, ClassVar

import h5py
import numpy as np
import pytest

from snakesfm.artifacts.hloc import write_hloc_matches
from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.sift import rootsift
from snakesfm.matching.matcher import MATCHERS
from snakesfm.stages.match_pairs import ImportedMatches

FEW = ((0, 0), (0, 50), (50, 0), (1, 1), (1, 50), (50, 1))


def keypoints(descriptors, name=""):
    rng = np.random.default_rng(0)
    count = len(descriptors)
    return KeypointSet(
        rng.uniform(0, 500, (count, 2)).astype(np.float32),
        descriptors,
        np.ones(count, np.float32),
        np.full(count, 3, np.float32),
        np.zeros(count, np.float32),
        image_name=name,
    )


def histograms(count, seed):
    rng = np.random.default_rng(seed)
    return rng.exponential(size=(count, 128)).astype(np.float32) ** 2


def check_matches(matches, scores, first, second):
    """The form of matches between images of ``first`` and ``second`` keypoints."""
    assert matches.dtype == np.int32 and scores.dtype == np.float32
    assert matches.shape == (len(scores), 2) and scores.ndim == 1
    assert (np.diff(matches[:, 0]) > 0).all() and len(np.unique(matches[:, 1])) == len(matches)
    assert (matches >= 0).all() and (matches < [first, second]).all()
    assert ((scores >= 0) & (scores <= 1)).all()


@pytest.mark.parametrize(
    ("matches", "scores"),
    [
        ([[0, 1], [0, 2]], [0.5, 0.5]),
        ([[0, 1], [2, 1]], [0.5, 0.5]),
        ([[2, 1], [0, 0]], [0.5, 0.5]),
        ([[0, 4]], [0.5]),
        ([[3, 0]], [0.5]),
        ([[0, -1]], [0.5]),
        ([[0, 1]], [1.5]),
        ([[0, 1]], [-0.1]),
        ([[0, 1]], [np.nan]),
        ([[0, 1]], [0.5, 0.5]),
    ],
)
def test_what_breaks_the_contract_is_noticed(matches, scores):
    with pytest.raises(AssertionError):
        check_matches(np.array(matches, np.int32), np.array(scores, np.float32), 3, 4)


def test_other_numbers_break_the_contract_too():
    matches, scores = np.array([[0, 3], [2, 1]], np.int32), np.array([0, 1], np.float32)
    check_matches(matches, scores, 3, 4)
    for wrong in ((matches.astype(np.int64), scores), (matches, scores.astype(np.float64))):
        with pytest.raises(AssertionError):
            check_matches(*wrong, 3, 4)


class MatcherContract:
    """Inherit, set ``method`` and ``detector``, and give a matcher and images of which the first two match."""

    method = ""
    detector = ""
    # matches of the first two images
    fewest = 1
    # by which scores of the same pair may differ
    same_tolerance = 0.0

    @pytest.fixture
    def matcher(self):
        raise NotImplementedError

    @pytest.fixture
    def images(self):
        """Keypoints of three images, 50 or more of each of the first two."""
        raise NotImplementedError

    def first_ones(self, image, count):
        """The first keypoints of an image."""
        return image.take(np.arange(count))

    @staticmethod
    def match(matcher, first, second):
        return matcher.match(matcher.prepare(first), matcher.prepare_second(second))

    @pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 0), (0, 2)])
    def test_matches_are_distinct_rows_in_order(self, matcher, images, first, second):
        matches, scores = self.match(matcher, images[first], images[second])
        check_matches(matches, scores, len(images[first]), len(images[second]))
        assert second == 2 or len(matches) >= self.fewest

    @pytest.mark.parametrize(("first", "second"), FEW)
    def test_few_or_no_keypoints(self, matcher, images, first, second):
        few = self.first_ones(images[0], first), self.first_ones(images[1], second)
        assert (len(few[0]), len(few[1])) == (first, second)
        check_matches(*self.match(matcher, *few), first, second)

    def test_a_pair_does_not_depend_on_the_pairs_before_it(self, matcher, images):
        prepared, second = matcher.prepare(images[0]), matcher.prepare_second(images[1])
        expected, scores = matcher.match(prepared, second)
        assert len(expected) >= self.fewest
        matcher.match(prepared, matcher.prepare_second(images[2]))
        for again in (matcher.match(prepared, second), self.match(matcher, *images[:2])):
            np.testing.assert_array_equal(again[0], expected)
            np.testing.assert_allclose(again[1], scores, rtol=0, atol=self.same_tolerance)


class MutualRatioContract(MatcherContract):
    """Set ``options`` where there are several ways to run it."""

    method = "mutual_ratio"
    detector = "sift"
    fewest = 200
    options: ClassVar[dict[str, Any]] = {}

    @pytest.fixture
    def matcher(self):
        return MATCHERS[self.method](**self.options)

    @pytest.fixture
    def images(self):
        """The second shows 300 places of the first again, the third none."""
        shared, noise = histograms(300, 1), histograms(300, 5) * 0.1
        first = np.concatenate([shared, histograms(200, 2)])
        second = np.concatenate([histograms(250, 3), shared + noise])
        return [keypoints(rootsift(one)) for one in (first, second, histograms(600, 4))]

    def test_finds_a_permutation(self, matcher):
        descriptors = rootsift(histograms(700, 1))
        order = np.random.default_rng(2).permutation(700)
        matches, _ = self.match(matcher, keypoints(descriptors), keypoints(descriptors[order]))
        np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])
        assert len(matches) == 700

    def test_finds_noisy_partners_among_others(self, matcher, images):
        matches, _ = self.match(matcher, *images[:2])
        right = matches[:, 1] == matches[:, 0] + 250
        assert right.mean() > 0.97 and right.sum() > 280

    def test_unrelated_images_hardly_match(self, matcher):
        first, second = (keypoints(rootsift(histograms(600, seed))) for seed in (1, 2))
        assert len(self.match(matcher, first, second)[0]) < 12

    def test_equal_descriptors_stay_one_to_one(self, matcher):
        same = keypoints(np.repeat(rootsift(histograms(1, 1)), 40, axis=0))
        check_matches(*self.match(matcher, same, same), 40, 40)

    def test_a_prepared_image_serves_any_number_of_pairs(self, matcher):
        images = [keypoints(rootsift(histograms(count, 1))) for count in (500, 300, 700, 400)]
        prepared = matcher.prepare(images[0])
        for second in (*images, *images[::-1]):
            expected = self.match(matcher, images[0], second)
            for one, other in zip(
                expected, matcher.match(prepared, matcher.prepare_second(second)), strict=True
            ):
                np.testing.assert_array_equal(one, other)

    def test_half_floats_are_matched_too(self, matcher):
        vectors = np.random.default_rng(1).normal(size=(300, 256))
        vectors = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float16)
        matches, scores = self.match(matcher, keypoints(vectors), keypoints(vectors[::-1]))
        np.testing.assert_array_equal(matches[:, 1], 299 - matches[:, 0])
        assert len(matches) == 300 and (scores > 0.9).all()

    def test_a_stricter_ratio_keeps_a_subset(self):
        first = keypoints(rootsift(histograms(300, 1)))
        second = keypoints(rootsift(histograms(300, 1) + histograms(300, 9)))
        found = []
        for ratio in (0.7, 0.8, 0.9, 1.0):
            matcher = MATCHERS["mutual_ratio"](**self.options, max_ratio=ratio)
            found.append(set(map(tuple, self.match(matcher, first, second)[0].tolist())))
        assert found[0] < found[1] < found[2] < found[3]


class TestExactMutualRatio(MutualRatioContract):
    options: ClassVar = {"words": 1}

    def test_agrees_with_the_definition(self):
        rng = np.random.default_rng(4)
        first = rng.integers(0, 60, (613, 128)).astype(np.uint8)
        second = np.clip(first[rng.permutation(613)[:402]] + rng.integers(-9, 10, (402, 128)), 0, 255)
        distance = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
        ordered = np.sort(distance, axis=1)
        nearest = distance.argmin(axis=1)
        good = (ordered[:, 0] <= 0.8 * ordered[:, 1]) & (distance.argmin(axis=0)[nearest] == np.arange(613))
        matcher = MATCHERS["mutual_ratio"](words=1, max_ratio=0.8)
        matches, scores = self.match(matcher, keypoints(first), keypoints(second.astype(np.uint8)))
        np.testing.assert_array_equal(matches[:, 0], np.flatnonzero(good))
        np.testing.assert_array_equal(matches[:, 1], nearest[good])
        np.testing.assert_allclose(scores, 1 - (ordered[:, 0] / ordered[:, 1])[good], atol=1e-6)


class TestClusteredMutualRatio(MutualRatioContract):
    options: ClassVar = {}


class TestClusteredMutualRatioOfManyWords(MutualRatioContract):
    options: ClassVar = {"words": 256, "probes": 4.5}


class TestVirtual(MatcherContract):
    """The oracle, whose descriptors are the points' numbers."""

    method = "virtual"
    detector = "virtual"
    fewest = 40

    @pytest.fixture
    def matcher(self):
        return MATCHERS[self.method]()

    @pytest.fixture
    def images(self):
        rng = np.random.default_rng(0)
        numbers = (rng.permutation(np.arange(start, start + 100)) for start in (0, 60, 300))
        return [keypoints(rows.astype("<u4").view(np.uint8).reshape(-1, 4)) for rows in numbers]

    def test_pairs_all_that_is_equal_and_nothing_else(self, matcher, images):
        matches, scores = self.match(matcher, *images[:2])
        first, second = (image.descriptors for image in images[:2])
        np.testing.assert_array_equal(first[matches[:, 0]], second[matches[:, 1]])
        assert len(matches) == 40 and (scores == 1).all()
        assert len(self.match(matcher, images[0], images[2])[0]) == 0


class TestImported(MatcherContract):
    """A file of hloc's, which knows pairs by the names of their images."""

    method = "imported"
    detector = "imported"
    fewest = 40

    @pytest.fixture
    def images(self):
        return [keypoints(rootsift(histograms(80, seed)), f"a/{seed}.jpg") for seed in range(3)]

    def first_ones(self, image, count):
        return replace(super().first_ones(image, count), image_name=f"{count} of {image.image_name}")

    @pytest.fixture
    def matcher(self, images, tmp_path):
        path = tmp_path / "matches.h5"
        partners = np.random.default_rng(0).permutation(len(images[1]))[: self.fewest]
        with h5py.File(path, "w") as file:
            self.write(file, *images[:2], partners)
            for first, second in FEW:
                few = self.first_ones(images[0], first), self.first_ones(images[1], second)
                self.write(file, *few, np.arange(min(first, second)))
        return ImportedMatches(path)

    @staticmethod
    def write(file, first, second, partners):
        """Write which keypoints of the second image the first ones of the first image match."""
        matches = np.column_stack([np.arange(len(partners)), partners])
        scores = np.linspace(1, 0.25, len(partners))
        write_hloc_matches(file, (first.image_name, second.image_name), matches, scores, len(first))

    def test_matches_are_those_of_the_file_either_way_round(self, matcher, images):
        matches, scores = self.match(matcher, *images[:2])
        np.testing.assert_array_equal(matches[:, 0], np.arange(40))
        np.testing.assert_allclose(scores, np.linspace(1, 0.25, 40), atol=1e-3)
        turned, same = self.match(matcher, *images[1::-1])
        order = np.argsort(turned[:, 1])
        np.testing.assert_array_equal(turned[order, ::-1], matches)
        np.testing.assert_array_equal(same[order], scores)

    def test_a_pair_that_the_file_lacks_has_none(self, matcher, images):
        assert len(self.match(matcher, images[0], images[2])[0]) == 0

    @pytest.mark.parametrize("pair", [(0, 0), (1, 1), (1, 50), (50, 1)])
    def test_few_keypoints_have_the_matches_of_the_file(self, matcher, images, pair):
        few = [self.first_ones(image, count) for image, count in zip(images[:2], pair, strict=True)]
        assert len(self.match(matcher, *few)[0]) == min(pair)
