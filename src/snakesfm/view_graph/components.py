"""Connected components of a view graph."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of


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
    components = components_of(node_count, pairs)
    sizes = np.bincount(components)
    ranks = np.empty(len(sizes), dtype=np.int32)
    ranks[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes), dtype=np.int32)
    return ranks[components]
