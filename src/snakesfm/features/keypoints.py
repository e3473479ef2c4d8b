"""Local features of one image, and the interface of detectors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.orientations import show_places, shown_size, store_places


@dataclass(frozen=True)
class KeypointSet:
    """Keypoints of one image with their descriptors.

    Parameters
    ----------
    keypoints : (N,2) float32, x and y in pixels, the first pixel's centre at (0.5, 0.5).
    descriptors : (N,D), dtype and length of the detector.
    scores : (N,) float32, larger is stronger.
    scales : (N,) float32, diameter in pixels.
    angles : (N,) float32, radians.
    image_size : width and height of the image, in the pixels of the keypoints; (0, 0) where not known.
    image_name : the image's path relative to the image folder; "" where not known.
    """

    keypoints: Array
    descriptors: Array
    scores: Array
    scales: Array
    angles: Array
    image_size: tuple[int, int] = (0, 0)
    image_name: str = ""

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, rows: Array) -> "KeypointSet":
        """The keypoints of some rows, in the order of ``rows``."""
        return replace(
            self,
            keypoints=self.keypoints[rows],
            descriptors=self.descriptors[rows],
            scores=self.scores[rows],
            scales=self.scales[rows],
            angles=self.angles[rows],
        )

    def unmasked(self, mask: Array, width: float, height: float) -> "KeypointSet":
        """The keypoints that lie where a mask is true.

        Parameters
        ----------
        mask : (H,W) bool over the whole image, of any size.
        width, height : size of the image in the pixels of the keypoints.
        """
        rows, columns = mask.shape
        return self.take(pixels_at(mask, self.keypoints * np.array([columns / width, rows / height])))

    def scaled(self, x: float, y: float) -> "KeypointSet":
        """The same keypoints in an image that is ``x`` times wider and ``y`` times higher.

        Edges map to edges: with the first pixel's centre at (0.5, 0.5) the coordinates are just multiplied.
        """
        return replace(
            self,
            keypoints=(self.keypoints * np.array([x, y])).astype(np.float32),
            scales=(self.scales * np.sqrt(x * y)).astype(np.float32),
            image_size=(round(self.image_size[0] * x), round(self.image_size[1] * y)),
        )

    def shown(self, orientation: int) -> "KeypointSet":
        """The same keypoints in the image as its EXIF orientation shows it; angles are not turned."""
        places = show_places(self.keypoints, self.image_size, orientation)
        return replace(self, keypoints=places, image_size=shown_size(self.image_size, orientation))

    def stored(self, orientation: int) -> "KeypointSet":
        """The keypoints of an image as shown in the image as it is stored; angles are not turned."""
        size = shown_size(self.image_size, orientation)
        return replace(self, keypoints=store_places(self.keypoints, size, orientation), image_size=size)

    @classmethod
    def empty(cls, descriptor_size: int, descriptor_dtype: Any) -> "KeypointSet":
        """No keypoints."""
        return cls(
            np.zeros((0, 2), np.float32),
            np.zeros((0, descriptor_size), descriptor_dtype),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
        )


def pixels_at(image: Array, keypoints: Array) -> Array:
    """The pixels (N,...) of an image (H,W,...) that keypoints (N,2) lie in, or are nearest to."""
    height, width = image.shape[:2]
    columns = np.clip(keypoints[:, 0].astype(np.int64), 0, width - 1)
    rows = np.clip(keypoints[:, 1].astype(np.int64), 0, height - 1)
    found: Array = image[rows, columns]
    return found


class Detector(Protocol):
    """Finds and describes keypoints; a new one joins by an entry in ``DETECTORS``."""

    @property
    def descriptor_size(self) -> int:
        """Length D of a descriptor."""

    @property
    def descriptor_dtype(self) -> Any:
        """Numpy dtype of a descriptor: uint8 or float16."""

    @property
    def usual_keypoints(self) -> int:
        """How many keypoints per image are wanted where the user says nothing."""

    def detect(self, gray: Array, rgb: Array, max_keypoints: int) -> KeypointSet:
        """Find about ``max_keypoints`` or fewer keypoints, never missing a stronger one.

        Parameters
        ----------
        gray : (H,W) uint8.
        rgb : (H,W,3) uint8, the same image.
        max_keypoints : how many of the strongest are wanted; ties may give more.

        Returns
        -------
        Keypoints in the pixels of the image that is given, in any order.
        """


@runtime_checkable
class BatchDetector(Detector, Protocol):
    """A detector that is quicker on several images at once."""

    def detect_batch(self, images: Sequence[tuple[Array, Array]], max_keypoints: int) -> list[KeypointSet]:
        """What ``detect`` finds in each image, to rounding.

        Parameters
        ----------
        images : gray (H,W) and rgb (H,W,3) uint8 of each, of any sizes; those of one size share their work.
        max_keypoints : as in ``detect``.
        """


@runtime_checkable
class KeypointSource(Protocol):
    """Knows the keypoints of an image by its name; the other properties are those of a detector."""

    descriptor_size: int
    descriptor_dtype: Any
    usual_keypoints: int

    def read(self, name: str, size: tuple[int, int]) -> KeypointSet:
        """The keypoints of an image, in its pixels.

        Parameters
        ----------
        name : POSIX path relative to the image folder.
        size : width and height of the image in pixels.
        """
