"""Steps of the search for mutual nearest neighbours, and the ratio test."""

import numpy as np

from snakesfm.arrays import Array


def augmented(descriptors: Array, norm_first: bool) -> Array:
    """Descriptors (N,D) as (N,D+2) float32, of which two kinds multiply to -|a-b|^2/2."""
    count, size = descriptors.shape
    vectors = np.empty((count, size + 2), np.float32)
    vectors[:, :size] = descriptors
    half_norms = np.einsum("nd,nd->n", vectors[:, :size], vectors[:, :size]) / np.float32(2)
    vectors[:, size + (not norm_first)] = -half_norms
    vectors[:, size + norm_first] = 1
    return vectors


def pop_two_largest(block: Array) -> tuple[Array, Array, Array]:
    """Column of the largest of every row, its value, and the second largest value; overwrites ``block``."""
    here = np.arange(len(block))
    best = block.argmax(axis=1)
    first = block[here, best]
    block[here, best] = -np.inf
    # numpy's argmax is two to three times as fast as its max along rows
    return best, first, block[here, block.argmax(axis=1)]


def accept(
    nearest: Array, first: Array, second: Array, column_first: Array, max_ratio: float
) -> tuple[Array, Array]:
    """Keep what is mutual and passes the ratio test (Lowe 2004, section 7.1).

    Parameters
    ----------
    nearest : (N,) row of b that is nearest to each row of a.
    first, second : (N,) float32, -|a-b|^2/2 of the nearest and second nearest; -inf where there is none.
    column_first : (M,) float32, -|a-b|^2/2 of each row of b and its nearest row of a.
    max_ratio : largest ratio of the distances to the nearest and second nearest; 1 switches the test off.
        A row without a second nearest is never matched, nor with the test one whose two nearest are both
        equal to it.

    Returns
    -------
    matches : (K,2) int32, rows of a and b, ascending in a, each row at most once.
    scores : (K,) float32, one minus the ratio of distances, in 0 .. 1.
    """
    # rounding of float descriptors may lift the product of equal ones above zero
    first, second = np.minimum(first, 0), np.minimum(second, 0)
    passed = first >= np.float32(max_ratio**2) * second
    passed &= (second < 0) | (max_ratio == 1)
    passed &= (first == np.minimum(column_first, 0)[nearest]) & (second > -np.inf)
    kept = np.flatnonzero(passed)
    _, unique = np.unique(nearest[kept], return_index=True)
    kept = kept[np.sort(unique)]
    ratios = ratios_of(first[kept], second[kept])
    return np.column_stack([kept, nearest[kept]]).astype(np.int32), (1 - ratios).astype(np.float32)


def ratios_of(first: Array, second: Array) -> Array:
    """The distance to the nearest over that to the second nearest (N,) float32; 1 where both are 0.

    Parameters
    ----------
    first, second : (N,) float32, at most 0, as :func:`accept` has them.
    """
    ratios: Array = np.sqrt(np.divide(first, second, out=np.ones_like(first), where=second < 0))
    return ratios


def no_matches() -> tuple[Array, Array]:
    """What two images without a match give."""
    return np.zeros((0, 2), np.int32), np.zeros(0, np.float32)
