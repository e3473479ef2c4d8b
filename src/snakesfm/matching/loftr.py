"""LoFTR (Sun et al. 2021), by kornia: a network that matches images without keypoints."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.detector_sides import LEAST_SIDE_PX
from snakesfm.geometry.orientations import show_pixels, shown_size, store_places
from snakesfm.learned.batches import equal_rows
from snakesfm.learned.checkpoints import fill_network
from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor
from snakesfm.matching.detector_free import STRIP_IMAGES, Picture, no_coordinates

# those of a strip, and of the second images before and now; each takes 76 MB at 840 x 632 pixels
HELD_FEATURES = (STRIP_IMAGES, 2)


@dataclass(frozen=True)
class PreparedPicture:
    """An image in the size that a network sees; equal to others of its name.

    Parameters
    ----------
    name : POSIX path relative to the image folder.
    gray : (H,W) uint8 as shown, or None where the image is too small or of one tone.
    size : width and height, in pixels of the original, of what ``gray`` shows, as stored.
    orientation : how EXIF wants the image to be shown, 1..8.
    """

    name: str
    gray: Array | None = field(compare=False)
    size: tuple[int, int] = field(compare=False)
    orientation: int = field(compare=False)

    def to_stored(self, places: Array) -> Array:
        """Where places (N,2) of ``gray`` are in the original image as stored."""
        assert self.gray is not None
        ratios = np.array(shown_size(self.size, self.orientation)) / self.gray.shape[::-1]
        return store_places(places * ratios, self.size, self.orientation)


def shrink(picture: Picture, longer_side_px: int, multiple: int) -> PreparedPicture:
    """Scale a picture down to a longer side, and both sides to multiples; never up.

    Long pictures stay longer, so that their shorter side keeps what the network needs to find something.
    """
    gray = show_pixels(picture.gray, picture.orientation)
    height, width = gray.shape
    least = min(LEAST_SIDE_PX, height, width)
    factor = min(1.0, max(longer_side_px / max(height, width), least / min(height, width)))
    # the product may fall short of the least by rounding
    columns, rows = (max(int(side * factor), least) // multiple * multiple for side in (width, height))
    small = None
    if min(columns, rows) >= LEAST_SIDE_PX and gray.min() != gray.max():
        small = cv2.resize(gray, (columns, rows), interpolation=cv2.INTER_AREA)
    size = (picture.gray.shape[1] * picture.reduction, picture.gray.shape[0] * picture.reduction)
    return PreparedPicture(picture.name, small, size, picture.orientation)


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
        # the larger part of a pair's time; second images must not displace the first ones of a strip
        self._see = [functools.lru_cache(count)(self._extract) for count in HELD_FEATURES]

    def prepare(self, first: Picture) -> PreparedPicture:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        return shrink(first, self._longer_side_px, self.multiple)

    prepare_second = prepare

    def _extract(self, picture: PreparedPicture) -> dict[str, Any]:
        assert picture.gray is not None
        features: dict[str, Any] = self._network.extract_features(to_tensor([picture.gray]))
        return features

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
            sides = {}
            for side, pictures in enumerate(zip(*pairs, strict=True)):
                seen = [self._see[side](picture) for picture in pictures]
                sides[f"features{side}"] = {
                    name: torch.cat([features[name] for features in seen]) for name in seen[0]
                }
            found = self._network(sides)
        numbers = found["batch_indexes"].cpu().numpy()
        places = [to_array(found[name], np.float64) for name in ("keypoints0", "keypoints1")]
        scores = to_array(found["confidence"], np.float32)
        results = []
        for number, (one, other) in enumerate(pairs):
            own = numbers == number
            ends = np.hstack([one.to_stored(places[0][own]), other.to_stored(places[1][own])])
            inside = ((ends >= 0) & (ends < (*one.size, *other.size))).all(axis=1)
            coordinates = ends[inside].astype(np.float32)
            results.append((coordinates, np.clip(scores[own][inside], 0, 1).astype(np.float32)))
        return results
