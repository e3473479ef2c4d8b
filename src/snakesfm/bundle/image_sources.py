"""Gray images at the resolutions at which keypoints are refined."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.alignment import AlignmentSettings, GrayImage
from snakesfm.geometry.detector_sides import USUAL_SIDE_PX

if TYPE_CHECKING:
    from snakesfm.ingest.read import ImagePixels

HELD_PIXELS = 256 * USUAL_SIDE_PX * (USUAL_SIDE_PX * 3 // 2)
"""Gray values that are kept, as each image is read thrice: those of so many photographs of usual size."""
LEAST_GAIN = 1.25
"""Images that are less finer than those before tell nothing new."""
RADIUS_GROWTH = 0.68
"""Patches grow by 1.6 where images are twice as fine: they show less of a surface, but not noise alone."""


@dataclass(frozen=True)
class ImageSource:
    """Where the pixels come from that keypoints are refined with.

    Parameters
    ----------
    read_gray : gives the image of a row, or None where it cannot be read.
    scales : (N,) how many detector pixels a pixel of each gray image is wide, at most.
    settings : how observations are aligned.
    report : called with how many observations were aligned or are templates, and how many there are.
    release : frees the images that are kept.
    """

    read_gray: Callable[[int], GrayImage | None]
    scales: Array
    settings: AlignmentSettings
    report: Callable[[int, int], None]
    release: Callable[[], None]


def open_image_sources(
    read_image: "Callable[[int, int], ImagePixels | None]",
    sizes: Array,
    detector_scales: Array,
    finenesses: Sequence[float],
    settings: AlignmentSettings,
) -> list[ImageSource]:
    """Sources of the images, each finer than the one before; nothing is read yet.

    Parameters
    ----------
    read_image : gives the image of a row, its shorter side at least so many pixels if it has them; or None.
    sizes : (N,2) their widths and heights in original pixels.
    detector_scales : (N,) how many original pixels a detector pixel of each is wide.
    finenesses : how much smaller than the detector's the pixels are, ascending; those that the images are
        too small for are left out, all but the first.
    settings : radius of the patches in pixels of the detector; the finer images have larger ones.
    """
    sources: list[ImageSource] = []
    before = np.ones(len(sizes))
    for fineness in finenesses:
        reductions = np.maximum(1.0, detector_scales / fineness)
        gain = float(np.median(before / reductions)) if len(sizes) else 1.0
        if sources and gain < LEAST_GAIN:
            break
        finer = float(np.median(detector_scales / reductions)) if len(sizes) else 1.0
        patches = replace(settings, radius_px=round(settings.radius_px * finer**RADIUS_GROWTH))
        sources.append(_open_source(read_image, sizes, detector_scales, reductions, patches))
        before = reductions
    return sources


def _open_source(
    read_image: "Callable[[int, int], ImagePixels | None]",
    sizes: Array,
    detector_scales: Array,
    reductions: Array,
    settings: AlignmentSettings,
) -> ImageSource:
    """The images scaled down by ``reductions`` (N,)."""
    # not needed where keypoints are not refined
    from snakesfm.ingest.read import scale_down

    shorter_sides = np.rint(sizes.min(axis=1) / reductions).astype(int).tolist()
    pixels = float(np.median(sizes.prod(axis=1) / reductions**2)) if len(sizes) else 1.0
    # the images are worked on side by side
    cv2.setNumThreads(1)

    @lru_cache(maxsize=max(2 * settings.threads, int(HELD_PIXELS / pixels)))
    def read_gray(row: int) -> GrayImage | None:
        image = read_image(row, shorter_sides[row])
        if image is None:
            return None
        gray = scale_down(image.gray, shorter_sides[row])
        scale = image.reduction * np.array(image.gray.shape[::-1]) / np.array(gray.shape[::-1])
        return GrayImage(gray, scale / detector_scales[row])

    return ImageSource(
        read_gray,
        reductions / detector_scales,
        settings,
        lambda aligned, count: print(f"keypoints refined: {aligned} of {count} observations", flush=True),
        read_gray.cache_clear,
    )
