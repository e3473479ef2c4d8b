"""What every detector of local features must do."""

from typing import ClassVar

import cv2
import numpy as np
import pytest

from snakesfm.features.extraction import DETECTORS, extract_keypoints


def blobs(width=320, height=240, seed=3):
    """A gray image of random soft spots and its RGB copy."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 110.0)
    for x, y, radius, tone in zip(
        rng.uniform(0, width, 250),
        rng.uniform(0, height, 250),
        rng.uniform(2, 7, 250),
        rng.uniform(-90, 90, 250),
        strict=True,
    ):
        rows, columns = np.mgrid[:height, :width]
        image += tone * np.exp(-((columns + 0.5 - x) ** 2 + (rows + 0.5 - y) ** 2) / (2 * radius**2))
    gray = np.clip(image, 0, 255).astype(np.uint8)
    return gray, np.repeat(gray[..., None], 3, axis=2)


def shapes(width=320, height=240, seed=3):
    """A gray image of random soft-edged rectangles on a cloudy ground, and its RGB copy."""
    rng = np.random.default_rng(seed)
    image = cv2.resize(rng.uniform(60, 200, (6, 8)), (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(220):
        center, size = rng.uniform([0, 0], [width, height]), rng.uniform(6, 30, 2)
        corners = cv2.boxPoints((tuple(center), tuple(size), rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, np.rint(corners).astype(int), float(rng.uniform(0, 255)))
    gray = np.clip(cv2.GaussianBlur(image, (0, 0), 1.0), 0, 255).astype(np.uint8)
    return gray, np.repeat(gray[..., None], 3, axis=2)


def extract(detector, gray, rgb, max_keypoints, max_shorter_side_px):
    """The keypoints of one image."""
    return extract_keypoints(detector, [(gray, rgb)], max_keypoints, max_shorter_side_px)[0]


class DetectorContract:
    """Inherit, set ``method`` and, where blobs are not what it detects, ``picture``."""

    method = ""
    options: ClassVar[dict] = {}
    picture = staticmethod(blobs)

    @pytest.fixture
    def detector(self):
        return DETECTORS[self.method](**self.options)

    def test_is_registered(self):
        assert self.method in DETECTORS

    def test_finds_what_is_there(self, detector):
        gray, rgb = self.picture()
        found = extract(detector, gray, rgb, 5000, 760)
        assert 100 < len(found) <= 5000
        assert found.keypoints.dtype == np.float32 and found.keypoints.shape == (len(found), 2)
        assert found.descriptors.dtype == detector.descriptor_dtype
        assert found.descriptors.shape == (len(found), detector.descriptor_size)
        assert (found.keypoints > 0).all() and (found.keypoints < [320, 240]).all()
        assert (np.diff(found.scores) <= 0).all()
        assert np.isfinite(found.scales).all() and (found.scales > 0).all()
        assert found.image_size == (320, 240)
        assert detector.usual_keypoints >= 16

    def test_a_budget_keeps_the_strongest(self, detector):
        gray, rgb = self.picture()
        everything = extract(detector, gray, rgb, 5000, 760)
        few = extract(detector, gray, rgb, 40, 760)
        assert len(few) == 40
        np.testing.assert_array_equal(few.keypoints, everything.keypoints[:40])
        np.testing.assert_array_equal(few.descriptors, everything.descriptors[:40])

    def test_no_place_is_there_twice(self, detector):
        gray, rgb = self.picture()
        found = extract(detector, gray, rgb, 5000, 760)
        assert len(np.unique(found.keypoints, axis=0)) == len(found)

    @pytest.mark.parametrize("shape", [(1, 1), (5, 300), (64, 64), (240, 320)])
    def test_an_image_without_features_has_none(self, detector, shape):
        gray = np.full(shape, 128, np.uint8)
        found = extract(detector, gray, np.repeat(gray[..., None], 3, axis=2), 5000, 760)
        assert found.keypoints.shape == (0, 2)
        assert found.descriptors.shape == (0, detector.descriptor_size)
        assert found.descriptors.dtype == detector.descriptor_dtype

    def test_is_deterministic_whatever_the_threads(self, detector):
        gray, rgb = self.picture()
        results = []
        before = cv2.getNumThreads()
        try:
            for threads in (1, 2, 1):
                cv2.setNumThreads(threads)
                results.append(extract(detector, gray, rgb, 200, 760))
        finally:
            cv2.setNumThreads(before)
        for other in results[1:]:
            np.testing.assert_array_equal(other.keypoints, results[0].keypoints)
            np.testing.assert_array_equal(other.descriptors, results[0].descriptors)


class BlobDetectorContract(DetectorContract):
    def test_pixels_are_those_of_the_original(self, detector):
        # spots' centres, given in the convention of the first pixel's centre at (.5, .5)
        rng = np.random.default_rng(0)
        rows, columns = np.mgrid[:480, :640] + 0.5
        centers = np.mgrid[60:600:90, 60:440:90].reshape(2, -1).T + rng.uniform(size=(30, 2))
        image = np.full((480, 640), 60.0)
        for x, y in centers:
            image += 150 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * rng.uniform(5, 9) ** 2))
        gray = np.clip(image, 0, 255).astype(np.uint8)
        rgb = np.repeat(gray[..., None], 3, axis=2)
        for shorter_side in (480, 240, 171):
            found = extract(detector, gray, rgb, 1000, shorter_side).keypoints
            nearest = np.linalg.norm(found[None] - centers[:, None], axis=2).argmin(axis=1)
            offset = found[nearest] - centers
            seen = np.linalg.norm(offset, axis=1) < 2
            assert seen.sum() >= 27
            assert np.abs(np.median(offset[seen], axis=0)).max() < 0.02, shorter_side
            assert 1e-4 < np.median(np.linalg.norm(offset[seen], axis=1)) < 0.15


class TestSift(BlobDetectorContract):
    method = "sift"


class TestUprightSift(BlobDetectorContract):
    method = "sift"
    options: ClassVar[dict] = {"upright": True}

    def test_angles_are_zero(self, detector):
        found = extract(detector, *blobs(), 5000, 760)
        assert not found.angles.any()
