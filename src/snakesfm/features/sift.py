"""SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelovic and Zisserman 2012), by OpenCV."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.features.keypoints import KeypointSet

# entries of a unit RootSIFT vector rarely exceed one half, so 512 uses all of uint8
ROOTSIFT_SCALE = 512.0
OCTAVE_LAYERS = 3
BASE_SIGMA = 1.6
SMALLEST_SIDE_PX = 8
# doubling that blurs all pixels alike finds more and better placed keypoints than OpenCV's "precise" one,
# but leaves them a quarter of a pixel off; OpenCV's first pixel has its centre at (0, 0)
ALIGNED_DOUBLING = False
CENTER_SHIFT = np.float32(0.5 - 0.25)


def rootsift(descriptors: Array) -> Array:
    """SIFT histograms (N,128) float32 to 512 x RootSIFT (N,128) uint8, clipped to 255."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    scaled = ROOTSIFT_SCALE * np.sqrt(descriptors / sums)
    whole: Array = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
    return whole


@dataclass(frozen=True)
class SiftDetector:
    """SIFT on the doubled image.

    Parameters
    ----------
    contrast_threshold, edge_threshold : as in OpenCV's ``SIFT_create``.
    upright : describe all keypoints at angle 0 instead of along their gradients.
    """

    contrast_threshold: float = 0.01
    edge_threshold: float = 10.0
    upright: bool = False
    descriptor_size: int = 128
    descriptor_dtype: Any = np.uint8
    usual_keypoints: int = 5000

    def detect(self, gray: Array, rgb: Array, max_keypoints: int) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.Detector`."""
        if min(gray.shape) < SMALLEST_SIDE_PX:
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        # a place has 1.2 orientations on average, so one round nearly always finds enough places
        wanted = int(1.3 * max_keypoints) + 16
        while True:
            found, descriptors, exhausted = self._detect_all(gray, wanted)
            if descriptors is None or len(found) == 0:
                return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
            place = np.array([point.pt for point in found], dtype=np.float32)
            scores = np.array([point.response for point in found], dtype=np.float32)
            angles = np.array([point.angle for point in found], dtype=np.float32)
            rows = _one_per_place(place, scores, angles, descriptors)
            if len(rows) >= max_keypoints or exhausted:
                break
            wanted *= 2
        return KeypointSet(
            place[rows] + CENTER_SHIFT,
            rootsift(descriptors[rows]),
            scores[rows],
            np.array([found[row].size for row in rows], dtype=np.float32),
            np.deg2rad(angles[rows]),
        )

    def _detect_all(self, gray: Array, wanted: int) -> tuple[Any, Any, bool]:
        """The strongest keypoints of all orientations, and whether there are no more."""
        sift = cv2.SIFT.create(
            wanted,
            OCTAVE_LAYERS,
            self.contrast_threshold,
            self.edge_threshold,
            BASE_SIGMA,
            cv2.CV_32F,
            ALIGNED_DOUBLING,
        )
        if not self.upright:
            found, descriptors = sift.detectAndCompute(gray, None)
            return found, descriptors, len(found) < wanted
        found = sift.detect(gray, None)
        places: dict[tuple[float, float], Any] = {}
        for point in sorted(found, key=lambda point: -point.response):
            point.angle = 0.0
            places.setdefault(point.pt, point)
        upright, descriptors = sift.compute(gray, list(places.values()))
        return upright, descriptors, len(found) < wanted


def _one_per_place(places: Array, scores: Array, angles: Array, descriptors: Array) -> Array:
    """Rows (M,) of the strongest and best aligned keypoint of each place (N,2).

    Lowe describes a place once per strong orientation; of several, the one whose histograms (N,128) hold
    most gradients along the keypoint's own orientation is the dominant one.
    """
    along = descriptors.reshape(-1, 16, 8)[:, :, 0].sum(axis=1)
    order = np.lexsort((angles, -along, -scores, places[:, 1], places[:, 0]))
    sorted_places = places[order]
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (sorted_places[1:] != sorted_places[:-1]).any(axis=1)
    rows: Array = order[starts]
    return rows
