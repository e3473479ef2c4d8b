"""From an image to its strongest keypoints."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from snakesfm.features.keypoints import Detector, KeypointSet
from snakesfm.features.sift import SiftDetector

Array = NDArray[Any]


def _learned(name: str) -> Callable[..., Detector]:
    """A detector of features.learned, whose libraries load when one is made."""

    def make(**options: Any) -> Detector:
        module = importlib.import_module("snakesfm.features.learned")
        detector: Detector = getattr(module, name)(**options)
        return detector

    return make


DETECTORS: dict[str, Callable[..., Detector]] = {
    "sift": SiftDetector,
    "aliked": _learned("AlikedDetector"),
    "disk": _learned("DiskDetector"),
    "xfeat": _learned("XfeatDetector"),
    "superpoint": _learned("SuperpointDetector"),
}


def create_detector(method: str, **options: Any) -> Detector:
    """The detector of a name in ``DETECTORS``, with its own options."""
    return DETECTORS[method](**options)


def extract_keypoints(
    detector: Detector, gray: Array, rgb: Array, max_keypoints: int, max_shorter_side_px: int
) -> KeypointSet:
    """Find the strongest keypoints of an image.

    Parameters
    ----------
    detector : what finds and describes them.
    gray, rgb : (H,W) and (H,W,3) uint8, the image, whose pixels are those of the result.
    max_keypoints : most keypoints returned.
    max_shorter_side_px : larger images are scaled down to this before detection.

    Returns
    -------
    At most ``max_keypoints`` keypoints in the image's pixels, strongest first; ties are ordered by place,
    scale and angle, so the order depends on the image alone.
    """
    height, width = gray.shape
    small_gray, small_rgb = _shrink(gray, rgb, max_shorter_side_px)
    found = detector.detect(small_gray, small_rgb, max_keypoints)
    x, y = found.keypoints[:, 0], found.keypoints[:, 1]
    found = found.take(np.lexsort((found.angles, found.scales, x, y, -found.scores))[:max_keypoints])
    found = replace(found, image_size=small_gray.shape[::-1])
    return found.scaled(width / small_gray.shape[1], height / small_gray.shape[0])


def _shrink(gray: Array, rgb: Array, max_shorter_side_px: int) -> tuple[Array, Array]:
    height, width = gray.shape
    factor = max_shorter_side_px / min(height, width)
    if factor >= 1:
        return gray, rgb
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return (
        cv2.resize(gray, size, interpolation=cv2.INTER_AREA),
        cv2.resize(rgb, size, interpolation=cv2.INTER_AREA),
    )


def sample_colors(rgb: Array, keypoints: Array) -> Array:
    """RGB (N,3) uint8 of the pixels that keypoints (N,2) lie in."""
    height, width = rgb.shape[:2]
    columns = np.clip(keypoints[:, 0].astype(np.int64), 0, width - 1)
    rows = np.clip(keypoints[:, 1].astype(np.int64), 0, height - 1)
    return np.ascontiguousarray(rgb[rows, columns], dtype=np.uint8)
