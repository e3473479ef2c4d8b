"""LoFTR (Sun et al. 2021), by kornia: a network that matches images without keypoints."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor
from snakesfm.matching.detector_free import Picture, no_coordinates

Array = NDArray[Any]

# smaller images leave nothing within the border that LoFTR ignores
SMALLEST_SIDE_PX = 64


@dataclass(frozen=True)
class PreparedPicture:
    """An image in the size that a network sees.

    Parameters
    ----------
    gray : (H,W) uint8, or None where the image is too small or of one tone.
    ratios : (2,) float64, original pixels per pixel of ``gray`` along x and y.
    features : what the network computes of this image alone, or None.
    """

    gray: Array | None
    ratios: Array
    features: Any = None


def shrink(picture: Picture, longer_side_px: int, multiple: int) -> PreparedPicture:
    """Scale a picture down to a longer side, and both sides to multiples; never up."""
    height, width = picture.gray.shape
    factor = min(1.0, longer_side_px / max(height, width))
    columns, rows = (int(side * factor) // multiple * multiple for side in (width, height))
    ratios = np.array(picture.size) / [max(columns, 1), max(rows, 1)]
    if min(columns, rows) < SMALLEST_SIDE_PX or picture.gray.min() == picture.gray.max():
        return PreparedPicture(None, ratios)
    return PreparedPicture(cv2.resize(picture.gray, (columns, rows), interpolation=cv2.INTER_AREA), ratios)


class LoftrMatcher:
    """LoFTR, trained outdoors unless other weights are given.

    Its coordinates, as published, have the first pixel's centre at (0.5, 0.5) already (kornia's description
    of ``LoFTR``).

    Parameters
    ----------
    min_score : least confidence of a match, 0 .. 1.
    longer_side_px : larger images are scaled down to this.
    state : weights under the names of kornia; None for random ones.
    """

    multiple = 8

    def __init__(self, min_score: float, longer_side_px: int, state: Mapping[str, Any] | None) -> None:
        from kornia.feature import LoFTR
        from kornia.feature.loftr.loftr import default_cfg

        coarse = {**default_cfg["match_coarse"], "thr": min_score}
        network = LoFTR(None, {**default_cfg, "match_coarse": coarse})
        self._network = fill_network(network, state, "LoFTR", ("pos_encoding.pe",))
        self._longer_side_px = longer_side_px

    def prepare(self, first: Picture) -> PreparedPicture:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        small = self.prepare_second(first)
        return small if small.gray is None else PreparedPicture(small.gray, small.ratios, self._see(small))

    def prepare_second(self, second: Picture) -> PreparedPicture:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        return shrink(second, self._longer_side_px, self.multiple)

    def _see(self, picture: PreparedPicture) -> Any:
        assert picture.gray is not None
        with load_torch().inference_mode():
            return self._network.extract_features(to_tensor(picture.gray))

    def match(self, first: PreparedPicture, second: PreparedPicture) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        if first.gray is None or second.gray is None:
            return no_coordinates()
        with load_torch().inference_mode():
            found = self._network({"features0": first.features, "features1": self._see(second)})
        one = to_array(found["keypoints0"], np.float64) * first.ratios
        other = to_array(found["keypoints1"], np.float64) * second.ratios
        return _inside(one, other, to_array(found["confidence"], np.float32), first, second)


def _inside(
    one: Array, other: Array, scores: Array, first: PreparedPicture, second: PreparedPicture
) -> tuple[Array, Array]:
    """The matches of which both places lie in their images."""
    assert first.gray is not None and second.gray is not None
    good = np.ones(len(one), bool)
    for places, picture in ((one, first), (other, second)):
        size = np.array(picture.gray.shape[::-1]) * picture.ratios  # type: ignore[union-attr]
        good &= ((places >= 0) & (places < size)).all(axis=1)
    coordinates = np.column_stack([one, other])[good].astype(np.float32)
    return coordinates, np.clip(scores[good], 0, 1).astype(np.float32)
