"""Detectors that are networks: ALIKED, DISK and XFeat by kornia, SuperPoint by transformers."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from snakesfm.arrays import Array
from snakesfm.features.keypoints import KeypointSet
from snakesfm.learned.batches import equal_rows
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor

SMALLEST_SIDE_PX = 32
# networks put the first pixel's centre at (0, 0)
CENTER_SHIFT = 0.5
# places (N,2) float32 in pixels, and tensors: descriptors (N,D) and scores (N,)
Inferred = tuple[Array, Any, Any]


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
        return self.detect_batch([(gray, rgb)], max_keypoints)[0]

    def detect_batch(self, images: Sequence[tuple[Array, Array]], max_keypoints: int) -> list[KeypointSet]:
        """See :class:`snakesfm.features.keypoints.BatchDetector`."""
        found = [KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)] * len(images)
        shown = [
            row
            for row, (gray, _) in enumerate(images)
            if min(gray.shape) >= SMALLEST_SIDE_PX and gray.min() != gray.max()
        ]
        for same in equal_rows([images[row][0].shape for row in shown]):
            rows = [shown[part] for part in same]
            grays, rgbs = ([images[row][part] for row in rows] for part in (0, 1))
            with load_torch().inference_mode():
                inferred = self._infer(grays, rgbs, max_keypoints)
            for row, (places, descriptors, scores) in zip(rows, inferred, strict=True):
                found[row] = KeypointSet(
                    places,
                    to_array(descriptors, np.float16),
                    to_array(scores, np.float32),
                    np.ones(len(places), np.float32),
                    np.zeros(len(places), np.float32),
                )
        return found

    def _infer(self, grays: Sequence[Array], rgbs: Sequence[Array], max_keypoints: int) -> list[Inferred]:
        """What the network finds in images of one shape."""
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

    def _infer(self, grays: Sequence[Array], rgbs: Sequence[Array], max_keypoints: int) -> list[Inferred]:
        inferred = []
        for found in self._network(to_tensor(rgbs)):
            # without any score above the threshold the network falls back on the mean score
            kept = found.keypoint_scores > self.threshold
            places = to_array(found.keypoints[kept], np.float32) + np.float32(CENTER_SHIFT)
            inferred.append((places, found.descriptors[kept], found.keypoint_scores[kept]))
        return inferred


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

    def _infer(self, grays: Sequence[Array], rgbs: Sequence[Array], max_keypoints: int) -> list[Inferred]:
        inferred = []
        for found in self._network(to_tensor(rgbs), n=max_keypoints, pad_if_not_divisible=True):
            places = to_array(found.keypoints, np.float32) + np.float32(CENTER_SHIFT)
            inferred.append((places, found.descriptors, found.detection_scores))
        return inferred


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

    def _infer(self, grays: Sequence[Array], rgbs: Sequence[Array], max_keypoints: int) -> list[Inferred]:
        # whole pixels of the image that the network resized: their centres are half of such a pixel farther
        sides = np.array(grays[0].shape[::-1])
        ratio = sides / (sides // self.multiple * self.multiple)
        inferred = []
        for found in self._network.detectAndCompute(to_tensor(rgbs), top_k=max_keypoints):
            places = to_array(found["keypoints"], np.float64) + CENTER_SHIFT * ratio
            inferred.append((places.astype(np.float32), found["descriptors"], found["scores"]))
        return inferred


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

    def _infer(self, grays: Sequence[Array], rgbs: Sequence[Array], max_keypoints: int) -> list[Inferred]:
        # the encoder halves the image three times and leaves out what is over
        height, width = (side // self.stride * self.stride for side in grays[0].shape)
        inferred = []
        # the decoders look at the first image of a batch alone
        for encoded in self._network.encoder(to_tensor([gray[:height, :width] for gray in grays]))[0]:
            places, scores = self._network.keypoint_decoder(encoded[None])
            descriptors = self._network.descriptor_decoder(encoded[None], places)
            inferred.append((to_array(places, np.float32) + np.float32(CENTER_SHIFT), descriptors, scores))
        return inferred
