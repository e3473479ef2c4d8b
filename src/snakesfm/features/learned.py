"""Detectors that are networks: ALIKED, DISK and XFeat by kornia, SuperPoint by transformers."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor

Array = NDArray[Any]

SMALLEST_SIDE_PX = 32
# networks put the first pixel's centre at (0, 0)
CENTER_SHIFT = 0.5


class LearnedDetector:
    """What the learned detectors share: tensors in, arrays out, and images that hold nothing.

    Descriptors are of unit length, as float16. Nothing is known of a keypoint's scale and angle: all have a
    scale of one pixel and angle 0.
    """

    descriptor_size: ClassVar[int]
    descriptor_dtype: ClassVar[Any] = np.float16
    usual_keypoints: ClassVar[int] = 2048

    def detect(self, gray: Array, rgb: Array, max_keypoints: int) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.Detector`."""
        if min(gray.shape) < SMALLEST_SIDE_PX or gray.min() == gray.max():
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        with load_torch().inference_mode():
            places, descriptors, scores = self._infer(gray, rgb, max_keypoints)
        count = len(places)
        return KeypointSet(
            places,
            to_array(descriptors, np.float16),
            to_array(scores, np.float32),
            np.ones(count, np.float32),
            np.zeros(count, np.float32),
        )

    def _infer(self, gray: Array, rgb: Array, max_keypoints: int) -> tuple[Array, Any, Any]:
        """Places (N,2) float32 in pixels, and tensors: descriptors (N,D) and scores (N,)."""
        raise NotImplementedError


class AlikedDetector(LearnedDetector):
    """ALIKED-n16 (Zhao et al. 2023): keypoints to a fraction of a pixel.

    Parameters
    ----------
    state : the network's weights; None for random ones.
    """

    descriptor_size = 128
    threshold = 0.2

    def __init__(self, state: Mapping[str, Any] | None) -> None:
        from kornia.feature import ALIKED

        network = ALIKED("aliked-n16", detection_threshold=self.threshold)
        self._network = fill_network(network, state, "ALIKED", ("hw_grid",))

    def _infer(self, gray: Array, rgb: Array, max_keypoints: int) -> tuple[Array, Any, Any]:
        (found,) = self._network(to_tensor(rgb))
        # without any score above the threshold the network falls back on the mean score
        kept = found.keypoint_scores > self.threshold
        places = to_array(found.keypoints[kept], np.float32) + np.float32(CENTER_SHIFT)
        return places, found.descriptors[kept], found.keypoint_scores[kept]


class DiskDetector(LearnedDetector):
    """DISK (Tyszkiewicz et al. 2020), trained with depth: keypoints at whole pixels.

    Parameters
    ----------
    state : the network's weights; None for random ones.
    """

    descriptor_size = 128

    def __init__(self, state: Mapping[str, Any] | None) -> None:
        from kornia.feature import DISK

        self._network = fill_network(DISK(self.descriptor_size), state, "DISK")

    def _infer(self, gray: Array, rgb: Array, max_keypoints: int) -> tuple[Array, Any, Any]:
        (found,) = self._network(to_tensor(rgb), n=max_keypoints, pad_if_not_divisible=True)
        places = to_array(found.keypoints, np.float32) + np.float32(CENTER_SHIFT)
        return places, found.descriptors, found.detection_scores


class XfeatDetector(LearnedDetector):
    """XFeat (Potje et al. 2024): very cheap; keypoints at whole pixels of an image cut to multiples of 32.

    Parameters
    ----------
    state : the network's weights; None for random ones.
    """

    descriptor_size = 64
    multiple = 32

    def __init__(self, state: Mapping[str, Any] | None) -> None:
        from kornia.feature import XFeat

        self._network = XFeat().to("cpu")
        self._network.net = fill_network(self._network.net, state, "XFeat")

    def _infer(self, gray: Array, rgb: Array, max_keypoints: int) -> tuple[Array, Any, Any]:
        (found,) = self._network.detectAndCompute(to_tensor(rgb), top_k=max_keypoints)
        # whole pixels of the image that the network resized: their centres are half of such a pixel farther
        sides = np.array(gray.shape[::-1])
        ratio = sides / (sides // self.multiple * self.multiple)
        places = to_array(found["keypoints"], np.float64) + CENTER_SHIFT * ratio
        return places.astype(np.float32), found["descriptors"], found["scores"]


class SuperpointDetector(LearnedDetector):
    """SuperPoint (DeTone et al. 2018), by transformers: keypoints at whole pixels.

    Parameters
    ----------
    state : weights under the names of transformers; None for random ones.
    """

    descriptor_size = 256
    stride = 8

    def __init__(self, state: Mapping[str, Any] | None) -> None:
        from transformers import SuperPointConfig, SuperPointForKeypointDetection

        network = SuperPointForKeypointDetection(SuperPointConfig())
        self._network = fill_network(network, state, "SuperPoint")

    def _infer(self, gray: Array, rgb: Array, max_keypoints: int) -> tuple[Array, Any, Any]:
        # the encoder halves the image three times and leaves out what is over
        height, width = (side // self.stride * self.stride for side in gray.shape)
        encoded = self._network.encoder(to_tensor(gray[:height, :width]))[0]
        places, scores = self._network.keypoint_decoder(encoded)
        descriptors = self._network.descriptor_decoder(encoded, places)
        return to_array(places, np.float32) + np.float32(CENTER_SHIFT), descriptors, scores
