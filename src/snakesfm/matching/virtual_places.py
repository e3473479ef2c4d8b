"""The oracle ``virtual_places``: what a detector-free matcher would find if it were never wrong."""

from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.features.virtual import VirtualKeypoints
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.matching.detector_free import Picture, no_coordinates
from snakesfm.seeding import derive_seed


class VirtualPlaces:
    """Projections of a known model's points, found anew in each pair at some distance.

    As LoFTR does, it names another place near the point in each pair: both ends are shifted alike, by up to
    ``spread_px`` along each axis, and the second end is off by noise of a fraction of a pixel. The surer of
    two matches is the one nearer to its point.

    Parameters
    ----------
    model : COLMAP model with points.
    spread_px : largest shift of a place along x and along y.
    noise_px : standard deviation of the second end along x and along y.
    seed : of the shifts, together with the names of the two images.
    """

    def __init__(
        self, model: pycolmap.Reconstruction, spread_px: float, noise_px: float, seed: int
    ) -> None:
        self._source = VirtualKeypoints(model)
        self._spread_px = spread_px
        self._noise_px = noise_px
        self._seed = seed

    def prepare(self, first: Picture) -> tuple[str, tuple[int, int], Array, Array]:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        found = self._source.read(first.name, first.size)
        numbers = np.ascontiguousarray(found.descriptors).view("<u4").ravel()
        return first.name, first.size, numbers, found.keypoints

    prepare_second = prepare

    def match(self, first: Any, second: Any) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.detector_free.DetectorFreeMatcher`."""
        _, rows, others = np.intersect1d(first[2], second[2], return_indices=True)
        if len(rows) == 0:
            return no_coordinates()
        rng = np.random.default_rng(derive_seed(self._seed, "virtual_places", first[0], second[0]))
        shift = rng.uniform(-self._spread_px, self._spread_px, (len(rows), 2))
        noise = rng.normal(0, self._noise_px, (len(rows), 2))
        one, other = first[3][rows] + shift, second[3][others] + shift + noise
        scores = 1 - np.linalg.norm(shift, axis=1) / max(2 * self._spread_px, 1e-6)
        inside = ((one > 0) & (one < first[1]) & (other > 0) & (other < second[1])).all(axis=1)
        coordinates = np.column_stack([one, other])[inside].astype(np.float32)
        return coordinates, np.clip(scores[inside], 0, 1).astype(np.float32)
