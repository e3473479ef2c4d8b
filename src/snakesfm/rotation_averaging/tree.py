"""Rotations along a spanning tree: the start of the iterative averagers."""

import numpy as np

from snakesfm.arrays import Array


def tree_rotations(node_count: int, pairs: Array, rotations: Array, costs: Array) -> Array:
    """Rotations (N,3,3) that satisfy every edge of the spanning tree of least total cost.

    Parameters
    ----------
    node_count : N; the graph is connected.
    pairs : (E,2) int64.
    rotations : (E,3,3), j_from_i.
    costs : (E,) > 0.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    shape = (node_count, node_count)
    tree = minimum_spanning_tree(coo_array((costs, (pairs[:, 0], pairs[:, 1])), shape=shape).tocsr())
    degrees = np.bincount(np.concatenate(tree.nonzero()), minlength=node_count)
    root = int(np.argmax(degrees))
    order, parents = breadth_first_order(tree, root, directed=False, return_predecessors=True)
    keys = pairs[:, 0] * node_count + pairs[:, 1]
    averaged = np.empty((node_count, 3, 3))
    averaged[root] = np.eye(3)
    # SciPy gives int32, which keys of 50,000 images exceed
    children = order[1:].astype(np.int64)
    above = parents[children].astype(np.int64)
    edges = np.searchsorted(keys, np.minimum(children, above) * node_count + np.maximum(children, above))
    steps = np.where(
        (above < children)[:, None, None], rotations[edges], rotations[edges].transpose(0, 2, 1)
    )
    depths = np.zeros(node_count, dtype=np.int64)
    for child, parent in zip(children, above, strict=True):
        depths[child] = depths[parent] + 1
    levels = depths[children]
    for level in range(1, int(levels.max(initial=0)) + 1):
        rows = levels == level
        averaged[children[rows]] = steps[rows] @ averaged[above[rows]]
    return averaged
