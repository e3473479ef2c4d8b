"""Local features of one image, and the interface of what finds them."""

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


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
    """

    keypoints: Array
    descriptors: Array
    scores: Array
    scales: Array
    angles: Array

    def __len__(self) -> int:
        return len(self.keypoints)

    def take(self, rows: Array) -> "KeypointSet":
        """The keypoints of some rows, in the order of ``rows``."""
        return KeypointSet(
            self.keypoints[rows],
            self.descriptors[rows],
            self.scores[rows],
            self.scales[rows],
            self.angles[rows],
        )

    def scaled(self, x: float, y: float) -> "KeypointSet":
        """The same keypoints in an image that is ``x`` times wider and ``y`` times higher.

        Edges map to edges: with the first pixel's centre at (0.5, 0.5) the coordinates are just multiplied.
        """
        return replace(
            self,
            keypoints=(self.keypoints * np.array([x, y])).astype(np.float32),
            scales=(self.scales * np.sqrt(x * y)).astype(np.float32),
        )

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


class Detector(Protocol):
    """Finds and describes keypoints; a new one joins by an entry in ``DETECTORS``."""

    @property
    def descriptor_size(self) -> int:
        """Length D of a descriptor."""

    @property
    def descriptor_dtype(self) -> Any:
        """Numpy dtype of a descriptor: uint8 or float16."""

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
