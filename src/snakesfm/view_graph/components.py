"""Connected components of a view graph."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def label_components(node_count: int, pairs: Array) -> Array:
    """Component of every node, 0 the one with most nodes.

    Parameters
    ----------
    node_count : N, nodes without an edge included.
    pairs : (E,2) int, the edges.

    Returns
    -------
    (N,) int32; larger components first, equally large ones in the order of their first node.
    """
    roots = np.arange(node_count, dtype=np.int64)
    heads, tails = np.asarray(pairs, dtype=np.int64).reshape(-1, 2).T
    # numpy rather than scipy.sparse.csgraph, whose import takes longer than most whole jobs
    while True:
        lower = np.minimum(roots[heads], roots[tails])
        joined = roots.copy()
        np.minimum.at(joined, roots[heads], lower)
        np.minimum.at(joined, roots[tails], lower)
        while not np.array_equal(joined, joined[joined]):
            joined = joined[joined]
        if np.array_equal(joined, roots):
            break
        roots = joined
    firsts, inverse, sizes = np.unique(roots, return_inverse=True, return_counts=True)
    ranks = np.empty(len(firsts), dtype=np.int32)
    ranks[np.lexsort((firsts, -sizes))] = np.arange(len(firsts), dtype=np.int32)
    return ranks[inverse]
