"""Bridges of a view graph: edges that are the only connection between two parts."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of


def find_bridges(node_count: int, pairs: Array) -> Array:
    """Which edges of a graph, connected or not, are in no cycle.

    Every edge outside a spanning forest gets a random number; a forest edge is a bridge where the numbers
    of the edges that leave the part below it cancel out, so linear in time.

    Parameters
    ----------
    node_count : N.
    pairs : (E,2) int, the edges, none twice.

    Returns
    -------
    (E,) bool.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    edge_count = len(pairs)
    roots = np.unique(components_of(node_count, pairs), return_index=True)[1]
    # a further node that is joined to every component makes the forest a tree
    heads = np.concatenate([pairs[:, 0], np.full(len(roots), node_count)])
    tails = np.concatenate([pairs[:, 1], roots])
    numbers = np.arange(1, len(heads) + 1)
    size = node_count + 1
    lower, upper = np.minimum(heads, tails), np.maximum(heads, tails)
    joined = coo_array((numbers, (lower, upper)), shape=(size, size)).tocsr()
    order, parents = breadth_first_order(joined, node_count, directed=False, return_predecessors=True)
    children = order[1:].astype(np.int64)
    above = parents[children].astype(np.int64)
    keys = lower * size + upper
    by_key = np.argsort(keys)
    wanted = np.minimum(children, above) * size + np.maximum(children, above)
    tree_edges = by_key[np.searchsorted(keys[by_key], wanted)]
    labels = np.random.default_rng(0).integers(1, np.iinfo(np.int64).max, len(heads))
    labels[tree_edges] = 0
    sums = np.zeros(size, dtype=np.int64)
    np.bitwise_xor.at(sums, heads, labels)
    np.bitwise_xor.at(sums, tails, labels)
    for child, parent in zip(children[::-1].tolist(), above[::-1].tolist(), strict=True):
        sums[parent] ^= sums[child]
    bridges = np.zeros(len(heads), dtype=bool)
    bridges[tree_edges[sums[children] == 0]] = True
    return bridges[:edge_count]
