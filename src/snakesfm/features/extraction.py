"""From an image to its strongest keypoints."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.features.keypoints import BatchDetector, Detector, KeypointSet, pixels_at
from snakesfm.features.sift import SiftDetector
from snakesfm.ingest.read import scale_down
from snakesfm.lazy_loading import lazy

# of masks that leave less of an image, fewer keypoints than wanted may be found
SMALLEST_SHARE = 0.25


DETECTORS: dict[str, Callable[..., Detector]] = {
    "sift": SiftDetector,
    "aliked": lazy("features.learned", "AlikedDetector"),
    "disk": lazy("features.learned", "DiskDetector"),
    "xfeat": lazy("features.learned", "XfeatDetector"),
    "superpoint": lazy("features.learned", "SuperpointDetector"),
}


def extract_keypoints(
    detector: Detector,
    images: Sequence[tuple[Array, Array]],
    max_keypoints: int,
    max_shorter_side_px: int,
    masks: Sequence[Array | None] = (),
) -> list[KeypointSet]:
    """Find the strongest keypoints of images.

    Parameters
    ----------
    detector : what finds and describes them.
    images : gray (H,W) and rgb (H,W,3) uint8 of each, whose pixels are those of the result.
    max_keypoints : most keypoints returned of each.
    max_shorter_side_px : larger images are scaled down to this before detection.
    masks : of each image where keypoints are wanted, (H,W) bool of any size, or None for everywhere.

    Returns
    -------
    Of each image at most ``max_keypoints`` keypoints in its pixels, strongest first; ties are ordered by
    place, scale and angle, so the order depends on the image alone.
    """
    small = [
        (scale_down(gray, max_shorter_side_px), scale_down(rgb, max_shorter_side_px))
        for gray, rgb in images
    ]
    masks = masks or [None] * len(images)
    counts = [_count_before_mask(max_keypoints, mask) for mask in masks]
    if isinstance(detector, BatchDetector):
        found = detector.detect_batch(small, max(counts, default=max_keypoints))
    else:
        found = [
            detector.detect(gray, rgb, count) for (gray, rgb), count in zip(small, counts, strict=True)
        ]
    found = [
        points if mask is None else points.unmasked(mask, *seen[0].shape[::-1])
        for points, mask, seen in zip(found, masks, small, strict=True)
    ]
    return [
        _strongest(points, max_keypoints, seen[0].shape, original[0].shape)
        for points, seen, original in zip(found, small, images, strict=True)
    ]


def _count_before_mask(count: int, mask: Array | None) -> int:
    """How many keypoints are looked for where so many are wanted of a part of the image."""
    share = 1.0 if mask is None else float(mask.mean())
    return math.ceil(count / max(share, SMALLEST_SHARE))


def _strongest(
    found: KeypointSet, count: int, shape: tuple[int, ...], original: tuple[int, ...]
) -> KeypointSet:
    """The strongest keypoints of an image (H,W), in the pixels of the original (H,W)."""
    x, y = found.keypoints[:, 0], found.keypoints[:, 1]
    found = found.take(np.lexsort((found.angles, found.scales, x, y, -found.scores))[:count])
    found = replace(found, image_size=(shape[1], shape[0]))
    return found.scaled(original[1] / shape[1], original[0] / shape[0])


def sample_colors(rgb: Array, keypoints: Array) -> Array:
    """RGB (N,3) uint8 of the pixels that keypoints (N,2) lie in."""
    return np.ascontiguousarray(pixels_at(rgb, keypoints), dtype=np.uint8)
