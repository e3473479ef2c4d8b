"""LoFTR (Sun et al. 2021), by kornia: a network that matches images without keypoints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.detector_sides import LEAST_SIDE_PX
from snakesfm.learned.batches import equal_rows
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor
from snakesfm.matching.detector_free import Picture, no_coordinates


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
    """Scale a picture down to a longer side, and both sides to multiples; never up.

    Long pictures stay longer, so that their shorter side keeps what the network needs to find something.
    """
    height, width = picture.gray.shape
    least = min(LEAST_SIDE_PX, height, width)
    factor = min(1.0, max(longer_side_px / max(height, width), least / min(height, width)))
    # the product may fall short of the least by rounding
    columns, rows = (max(int(side * factor), least) // multiple * multiple for side in (width, height))
    ratios = np.array(picture.size) / [max(columns, 1), max(rows, 1)]
    if min(columns, rows) < LEAST_SIDE_PX or picture.gray.min() == picture.gray.max():
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
        return small if small.gray is None else replace(small, features=self._see([small]))

    def prepare_second(self, second: Picture) -> PreparedPicture:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        return shrink(second, self._longer_side_px, self.multiple)

    def _see(self, pictures: Sequence[PreparedPicture]) -> Any:
        grays = [picture.gray for picture in pictures if picture.gray is not None]
        with load_torch().inference_mode():
            return self._network.extract_features(to_tensor(grays))

    def match(self, first: PreparedPicture, second: PreparedPicture) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        return self.match_batch([(first, second)])[0]

    def match_batch(
        self, pairs: Sequence[tuple[PreparedPicture, PreparedPicture]]
    ) -> list[tuple[Array, Array]]:
        """See :class:`snakesfm.matching.matcher.BatchMatcher`."""
        results = [no_coordinates()] * len(pairs)
        shapes = [
            None if first.gray is None or second.gray is None else (first.gray.shape, second.gray.shape)
            for first, second in pairs
        ]
        for rows in equal_rows(shapes):
            if shapes[rows[0]] is not None:
                matched = self._match_equal([pairs[row] for row in rows])
                for row, result in zip(rows, matched, strict=True):
                    results[row] = result
        return results

    def _match_equal(
        self, pairs: Sequence[tuple[PreparedPicture, PreparedPicture]]
    ) -> list[tuple[Array, Array]]:
        """Match pairs of which all first images are of one shape, and all second ones."""
        torch = load_torch()
        with torch.inference_mode():
            first = {
                name: torch.cat([one.features[name] for one, _ in pairs]) for name in pairs[0][0].features
            }
            second = self._see([other for _, other in pairs])
            found = self._network({"features0": first, "features1": second})
        numbers = found["batch_indexes"].cpu().numpy()
        places = [to_array(found[name], np.float64) for name in ("keypoints0", "keypoints1")]
        scores = to_array(found["confidence"], np.float32)
        results = []
        for number, (one, other) in enumerate(pairs):
            own = numbers == number
            ends = (places[0][own] * one.ratios, places[1][own] * other.ratios)
            results.append(_inside(*ends, scores[own], one, other))
        return results


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
