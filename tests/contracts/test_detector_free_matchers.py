"""What every matcher without keypoints must do."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from contracts.test_detectors import shapes
from extras import import_extra

from snakesfm.evaluation.colmap_model import read_model
from snakesfm.features.virtual import VirtualKeypoints
from snakesfm.matching.detector_free import DETECTOR_FREE_MATCHERS, Picture
from snakesfm.matching.loftr import HELD_FEATURES, shrink


def picture(gray, name, reduction=1, orientation=1):
    size = (gray.shape[1] * reduction, gray.shape[0] * reduction)
    return Picture(name, size, gray, np.repeat(gray[..., None], 3, axis=2), reduction, orientation)


class DetectorFreeContract:
    """Inherit, set ``method``, and give a matcher and three pictures of which the first two match."""

    method = ""

    @pytest.fixture
    def matcher(self):
        raise NotImplementedError

    @pytest.fixture
    def pictures(self):
        raise NotImplementedError

    @staticmethod
    def match(matcher, first, second):
        return matcher.match(matcher.prepare(first), matcher.prepare_second(second))

    def test_is_registered(self):
        assert self.method in DETECTOR_FREE_MATCHERS

    def test_places_lie_in_their_images(self, matcher, pictures):
        coordinates, scores = self.match(matcher, pictures[0], pictures[1])
        assert coordinates.dtype == np.float32 and scores.dtype == np.float32
        assert coordinates.shape == (len(scores), 4) and len(scores) > 5
        assert ((scores >= 0) & (scores <= 1)).all()
        for part, image in ((coordinates[:, :2], pictures[0]), (coordinates[:, 2:], pictures[1])):
            assert (part >= 0).all() and (part < image.size).all()

    def test_a_pair_does_not_depend_on_the_pairs_before_it(self, matcher, pictures):
        prepared, second = matcher.prepare(pictures[0]), matcher.prepare_second(pictures[1])
        expected = matcher.match(prepared, second)
        matcher.match(prepared, matcher.prepare_second(pictures[2]))
        for one, other in zip(expected, matcher.match(prepared, second), strict=True):
            np.testing.assert_array_equal(one, other)

    @pytest.mark.parametrize("shape", [(1, 1), (40, 300), (240, 320)])
    def test_an_image_that_shows_nothing_matches_nothing(self, matcher, pictures, shape):
        black = picture(np.zeros(shape, np.uint8), "black")
        for first, second in ((black, pictures[0]), (pictures[0], black), (black, black)):
            coordinates, scores = self.match(matcher, first, second)
            assert coordinates.shape == (0, 4) and scores.shape == (0,)
            assert coordinates.dtype == np.float32 and scores.dtype == np.float32


class TestLoftr(DetectorFreeContract):
    """With random weights: shapes, pixels and independence, not how good its matches are."""

    method = "loftr"
    made: ClassVar[dict] = {}

    @pytest.fixture
    def matcher(self):
        torch = import_extra("torch")
        import_extra("kornia")
        if not self.made:
            torch.manual_seed(1)
            self.made["loftr"] = DETECTOR_FREE_MATCHERS["loftr"](
                min_score=0.0, longer_side_px=128, state=None
            )
        return self.made["loftr"]

    @pytest.fixture
    def pictures(self):
        grays = (shapes(128, 96)[0], shapes(104, 120)[0], shapes(128, 96, seed=8)[0])
        return [picture(gray, str(number)) for number, gray in enumerate(grays)]

    def test_places_are_those_of_the_original(self, matcher, pictures):
        gray = pictures[0].gray
        expected, _ = self.match(matcher, pictures[0], pictures[0])
        coordinates, _ = self.match(matcher, picture(gray, "a", 3), picture(gray, "b", 2))
        assert len(expected) > 5
        np.testing.assert_allclose(coordinates, expected * [3, 3, 2, 2], rtol=1e-5)

    @pytest.mark.parametrize(
        ("shape", "side", "seen"),
        [
            # of longer side 840, but for a panorama
            ((3000, 4000), 840, (624, 840)),
            ((1000, 16_000), 840, (64, 1024)),
            ((1640, 101), 840, (1032, 64)),
            ((480, 640), 64, (64, 80)),
            ((64, 900), 128, (64, 896)),
            ((63, 900), 128, None),
        ],
    )
    def test_the_shorter_side_keeps_what_the_network_needs(self, shape, side, seen):
        gray = np.zeros(shape, np.uint8)
        gray[0, 0] = 1
        small = shrink(picture(gray, "long"), side, 8)
        if seen is None:
            assert small.gray is None
            return
        assert small.gray.shape == seen
        np.testing.assert_allclose(small.to_stored(np.array([seen[::-1]])), [shape[::-1]])

    def test_a_picture_is_matched_as_it_is_shown(self, matcher, pictures):
        expected, scores = self.match(matcher, pictures[0], pictures[0])
        lying = picture(np.ascontiguousarray(np.rot90(pictures[0].gray)), "lying", 2, orientation=6)
        coordinates, again = self.match(matcher, pictures[0], lying)
        np.testing.assert_allclose(coordinates[:, :2], expected[:, :2])
        x, y = expected[:, 2:].T
        np.testing.assert_allclose(coordinates[:, 2:], 2 * np.column_stack([y, 128 - x]), rtol=1e-5)
        np.testing.assert_array_equal(again, scores)

    def test_an_image_is_seen_once_for_several_pairs(self, matcher, pictures, monkeypatch):
        seen = []
        network = matcher._network
        original = network.extract_features
        monkeypatch.setattr(
            network, "extract_features", lambda image: seen.append(image.shape) or original(image)
        )
        renamed = [replace(part, name=f"once {part.name}") for part in pictures]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            self.match(matcher, renamed[i], renamed[j])
        # the second image once on each side
        assert len(seen) == 4
        for number in range(HELD_FEATURES[1]):
            self.match(matcher, renamed[2], replace(pictures[0], name=f"more {number}"))
        self.match(matcher, renamed[2], renamed[0])
        assert len(seen) == 4 + 1 + HELD_FEATURES[1] + 1

    def test_long_images_are_matched(self, matcher):
        long = picture(shapes(960, 70)[0], "long")
        coordinates, _ = self.match(matcher, long, long)
        assert len(coordinates) > 5 and coordinates[:, 0].max() > 480
        assert (coordinates >= 0).all() and (coordinates < [960, 70, 960, 70]).all()

    def test_the_first_place_is_a_corner_of_a_coarse_cell(self, matcher, pictures):
        coordinates, _ = self.match(matcher, pictures[0], pictures[2])
        np.testing.assert_allclose(coordinates[:, :2] % 8, 0, atol=1e-4)

    def test_a_batch_gives_what_pairs_alone_give_in_any_order(self, matcher, pictures):
        # random networks find most in an image and its copy
        rows = [(0, 0), (0, 1), (2, 2), (0, 3), (1, 1)]
        pictures = [*pictures, picture(np.zeros((96, 128), np.uint8), "black")]
        prepared = [(matcher.prepare(pictures[i]), matcher.prepare_second(pictures[j])) for i, j in rows]
        apart = [matcher.match(*pair) for pair in prepared]
        assert [len(coordinates) > 5 for coordinates, _ in apart] == [True, True, True, False, True]
        for order in ([0, 1, 2, 3, 4], [3, 4, 2, 0, 1]):
            together = matcher.match_batch([prepared[row] for row in order])
            for row, (coordinates, scores) in zip(order, together, strict=True):
                np.testing.assert_allclose(coordinates, apart[row][0], atol=2e-3)
                np.testing.assert_allclose(scores, apart[row][1], rtol=1e-3, atol=1e-6)


class TestVirtualPlaces(DetectorFreeContract):
    method = "virtual_places"
    spread_px, noise_px = 2.0, 0.3

    @pytest.fixture
    def model(self, small_scene):
        return read_model(small_scene / "reference")

    @pytest.fixture
    def matcher(self, model):
        return DETECTOR_FREE_MATCHERS["virtual_places"](
            model=model, spread_px=self.spread_px, noise_px=self.noise_px, seed=1
        )

    @pytest.fixture
    def pictures(self, model):
        names = sorted(image.name for image in model.images.values())
        return [picture(np.full((300, 400), 9, np.uint8), name) for name in names[:3]]

    def test_places_are_near_the_points_that_both_images_see(self, matcher, pictures, model):
        known = VirtualKeypoints(model)
        coordinates, _ = self.match(matcher, pictures[0], pictures[1])
        for part, image in ((coordinates[:, :2], pictures[0]), (coordinates[:, 2:], pictures[1])):
            points = known.read(image.name, image.size).keypoints
            distance = np.linalg.norm(part[:, None] - points[None], axis=2).min(axis=1)
            assert distance.max() <= np.sqrt(2) * (self.spread_px + 5 * self.noise_px)
        assert len(coordinates) > 20

    def test_every_pair_finds_other_places(self, matcher, pictures):
        places = [self.match(matcher, pictures[0], second)[0][:, :2] for second in pictures[1:]]
        assert not set(map(tuple, places[0].tolist())) & set(map(tuple, places[1].tolist()))
