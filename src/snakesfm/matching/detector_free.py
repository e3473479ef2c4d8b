"""The interface of matchers without keypoints."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from snakesfm.arrays import Array
from snakesfm.lazy_loading import lazy

# pairs come in strips of so many first images, each second image with all of them before the next one
STRIP_IMAGES = 6


@dataclass(frozen=True)
class Picture:
    """One image as a detector-free matcher gets it.

    Parameters
    ----------
    name : POSIX path relative to the image folder.
    size : width and height of the original image in pixels.
    gray, rgb : (H,W) and (H,W,3) uint8, the image as stored or smaller, without the original's last pixels
        where these fill no pixel here.
    reduction : pixels of the original per pixel here, along x and y.
    orientation : how EXIF wants the image to be shown, 1..8.
    """

    name: str
    size: tuple[int, int]
    gray: Array
    rgb: Array
    reduction: int = 1
    orientation: int = 1


class DetectorFreeMatcher(Protocol):
    """Finds the same places in two images; a new one joins by an entry in ``DETECTOR_FREE_MATCHERS``.

    What is found depends on the two images and the options alone, not on the pairs before.
    """

    def prepare(self, first: Picture) -> Any:
        """Do once what all pairs of the image ``first`` need; the result goes into :meth:`match`."""

    def prepare_second(self, second: Picture) -> Any:
        """The same for the image ``second``; what it holds is not much more than the image."""

    def match(self, first: Any, second: Any) -> tuple[Array, Array]:
        """Match two images that are prepared.

        Returns
        -------
        coordinates : (M,4) float32, x and y in the first and in the second image, in pixels of the original
            images, the first pixel's centre at (0.5, 0.5).
        scores : (M,) float32 in 0 .. 1, larger is better.
        """


def no_coordinates() -> tuple[Array, Array]:
    """What two images that share nothing give."""
    return np.zeros((0, 4), np.float32), np.zeros(0, np.float32)


DETECTOR_FREE_MATCHERS: dict[str, Callable[..., DetectorFreeMatcher]] = {
    "loftr": lazy("matching.loftr", "LoftrMatcher"),
    "virtual_places": lazy("matching.virtual_places", "VirtualPlaces"),
}
