"""Mutual nearest neighbours with the ratio test, as one blocked matrix product."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

# a block of products then stays in the processor's second and third cache
ROWS_AT_ONCE = 256


def match_mutual_ratio(a: Array, b: Array, max_ratio: float) -> tuple[Array, Array]:
    """Match descriptors that are each other's nearest and pass the ratio test (Lowe 2004, section 7.1).

    All of -|a-b|^2/2 comes out of one matrix product with two extra columns, block by block of rows; the
    nearest of every column is carried along, so there is no second product for the way back. On uint8
    descriptors of moderate length (512 x RootSIFT) every sum is an integer or a half that float32 holds
    exactly: the result depends neither on the blocks nor on the BLAS.

    Parameters
    ----------
    a, b : descriptors (N,D) and (M,D) of two images, any real dtype.
    max_ratio : largest ratio of the distances of a row of ``a`` to its nearest and second nearest in ``b``;
        1 switches the test off. An image with fewer than two descriptors has no second nearest: no matches.

    Returns
    -------
    matches : (K,2) int32, rows of ``a`` and ``b``, ascending in ``a``, each row at most once.
    scores : (K,) float32, one minus the ratio of distances, in 0 .. 1.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int32), np.zeros(0, np.float32)
    left, right = _augmented(a, norm_first=True), _augmented(b, norm_first=False).T
    nearest = np.empty(len(a), np.int64)
    first, second = np.empty(len(a), np.float32), np.empty(len(a), np.float32)
    column_first = np.full(len(b), -np.inf, np.float32)
    buffer = np.empty((min(ROWS_AT_ONCE, len(a)), len(b)), np.float32)
    for start in range(0, len(a), ROWS_AT_ONCE):
        rows = slice(start, min(start + ROWS_AT_ONCE, len(a)))
        block = np.matmul(left[rows], right, out=buffer[: rows.stop - start])
        np.maximum(column_first, block.max(axis=0), out=column_first)
        best = block.argmax(axis=1)
        here = np.arange(len(best))
        nearest[rows], first[rows] = best, block[here, best]
        block[here, best] = -np.inf
        second[rows] = block.max(axis=1)
    # rounding of float descriptors may lift the product of equal ones above zero
    first, second = np.minimum(first, 0), np.minimum(second, 0)
    passed = (first >= np.float32(max_ratio**2) * second) & (first == np.minimum(column_first, 0)[nearest])
    kept = np.flatnonzero(passed)
    _, unique = np.unique(nearest[kept], return_index=True)
    kept = kept[np.sort(unique)]
    ratios = np.sqrt(
        np.divide(first[kept], second[kept], out=np.ones(len(kept), np.float32), where=second[kept] < 0)
    )
    return np.column_stack([kept, nearest[kept]]).astype(np.int32), (1 - ratios).astype(np.float32)


def _augmented(descriptors: Array, norm_first: bool) -> Array:
    """Descriptors (N,D) as (N,D+2) float32, of which two kinds multiply to -|a-b|^2/2."""
    count, size = descriptors.shape
    vectors = np.empty((count, size + 2), np.float32)
    vectors[:, :size] = descriptors
    half_norms = np.einsum("nd,nd->n", vectors[:, :size], vectors[:, :size]) / np.float32(2)
    vectors[:, size + (not norm_first)] = -half_norms
    vectors[:, size + norm_first] = 1
    return vectors
