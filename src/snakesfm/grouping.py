"""Rows of arrays that belong together."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from snakesfm.arrays import Array


def rows_of_each(values: Array) -> list[tuple[int, Array]]:
    """Each distinct of the values (n,) int, ascending, and the rows (k,) that have it, ascending."""
    if not len(values):
        return []
    order = np.argsort(values, kind="stable")
    found, starts = np.unique(values[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, starts[1:]), strict=True))


def starts_of(*columns: Array) -> Array:
    """Rows (n,) bool at which a run of rows begins that have the same values in all ``columns`` (n,)."""
    starts = np.zeros(len(columns[0]), dtype=bool)
    starts[:1] = True
    for column in columns:
        starts[1:] |= column[1:] != column[:-1]
    return starts


def offsets_of(lengths: ArrayLike) -> Array:
    """Offsets (n+1,) int64 of groups that follow each other: group k is the rows offsets[k]:offsets[k+1].

    Parameters
    ----------
    lengths : (n,) int, rows of each group.
    """
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])


def join_parts(parts: Sequence[Sequence[Array]], nothing: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Offsets (n+1,) of parts that follow each other, and each of their columns as one array.

    Parameters
    ----------
    parts : n of them, each of columns with equally many rows.
    nothing : a part without rows, whose columns keep shapes and dtypes where there is no part.
    """
    columns = [np.concatenate(column) for column in zip(nothing, *parts, strict=True)]
    return offsets_of([len(part[0]) for part in parts]), columns


def sum_by(values: Array, groups: Array, count: int) -> Array:
    """Sums (count, ...) of values (Q, ...) over the groups (Q) that they belong to, in their order.

    By a sparse product, which reads many numbers per row in one pass: a pass for each takes several times
    as long where they no longer fit the processor's caches.
    """
    from scipy.sparse import csc_array

    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    ones, places = np.ones(len(groups)), np.arange(len(groups) + 1)
    sums = csc_array((ones, groups, places), shape=(count, len(groups))) @ flat
    return np.asarray(sums.reshape(count, *values.shape[1:]))


def components_of(count: int, links: Array) -> Array:
    """Connected component of each of ``count`` nodes, (count,) int64, in the order of their first nodes.

    Parameters
    ----------
    links : (M,2) int, nodes in 0 .. count-1.
    """
    nodes = np.arange(count)
    roots = nodes
    heads, tails = np.asarray(links, dtype=np.int64).reshape(-1, 2).T
    # numpy rather than scipy.sparse.csgraph, whose import takes longer than most whole jobs
    while True:
        lower = np.minimum(roots[heads], roots[tails])
        joined = roots.copy()
        np.minimum.at(joined, roots[heads], lower)
        np.minimum.at(joined, roots[tails], lower)
        while not np.array_equal(joined, further := joined[joined]):
            joined = further
        if np.array_equal(joined, roots):
            return np.asarray((np.cumsum(roots == nodes) - 1)[roots])
        roots = joined


def one_to_one(pairs: Array) -> Array:
    """Rows (K,) int64 ascending of pairs (M,2), taken in their order where both numbers are still free."""
    taken, left = [np.zeros(0, np.int64)], np.arange(len(pairs))
    while len(left):
        # of the pairs that are left, one that is the first of both its numbers is taken whatever the others
        firsts, seconds = (np.unique(pairs[left, side], return_index=True)[1] for side in (0, 1))
        best = left[np.intersect1d(firsts, seconds, assume_unique=True)]
        taken.append(best)
        left = left[~(np.isin(pairs[left, 0], pairs[best, 0]) | np.isin(pairs[left, 1], pairs[best, 1]))]
    return np.sort(np.concatenate(taken))
