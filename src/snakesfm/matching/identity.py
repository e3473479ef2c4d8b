"""Matching by equal descriptors: the matcher of the oracle ``virtual``."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.nearest import no_matches


class IdentityMatcher:
    """Pairs keypoints whose descriptors are equal byte by byte; each image holds a descriptor once."""

    def prepare(self, first: KeypointSet) -> Array:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        return _as_keys(first.descriptors)

    prepare_second = prepare

    def match(self, first: Array, second: Array) -> tuple[Array, Array]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        if len(first) == 0 or len(second) == 0:
            return no_matches()
        _, rows, columns = np.intersect1d(first, second, assume_unique=True, return_indices=True)
        order = np.argsort(rows)
        matches = np.column_stack([rows, columns])[order].astype(np.int32)
        return matches, np.ones(len(matches), np.float32)


def _as_keys(descriptors: Array) -> Array:
    """Descriptors (N,D) as (N,) opaque values that can be sorted and compared."""
    rows = np.ascontiguousarray(descriptors)
    keys: Array = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    return keys
