"""Which links between matched keypoints 3-cycles confirm."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of

ROWS_AT_ONCE = 200_000


def cycle_support(links: Array, count: int) -> Array:
    """How many 3-cycles of links confirm each link.

    Parameters
    ----------
    links : (M,2) int64, nodes in 0 .. count-1; each link once.
    count : number of nodes.

    Returns
    -------
    (M,) int64: nodes that are linked to both ends of the link.
    """
    from scipy.sparse import csr_matrix

    ones = np.ones(len(links), dtype=np.int32)
    half = csr_matrix((ones, (links[:, 0], links[:, 1])), shape=(count, count))
    adjacency = half + half.T
    order = np.argsort(links[:, 0], kind="stable")
    bounds = np.searchsorted(links[order, 0], np.arange(0, count + ROWS_AT_ONCE, ROWS_AT_ONCE))
    support = np.zeros(len(links), dtype=np.int64)
    # the paths of all nodes at once would take more memory than all else together
    for k, start in enumerate(range(0, count, ROWS_AT_ONCE)):
        mine = order[bounds[k] : bounds[k + 1]]
        rows = slice(start, start + ROWS_AT_ONCE)
        paths = (adjacency[rows] @ adjacency).multiply(half[rows]).tocsr()
        support[mine] = np.asarray(paths[links[mine, 0] - start, links[mine, 1]]).ravel()
    return support


def unconfirmed_links(links: Array, images: Array) -> Array:
    """Links that no 3-cycle confirms, where being confirmed is the rule.

    A wrong match joins the tracks of two points though no image sees both; the longest tracks of a scene
    with look-alikes are such. A right one has mostly been found by way of a third image too. Asked are
    only links at keypoints that some 3-cycle confirms. It is the rule in image pairs with more confirmed
    links than others, and between two images of which each has more, if such pairs connect them otherwise.

    Parameters
    ----------
    links : (M,2) int64, nodes in 0 .. K-1; each link once.
    images : (K,) int64, image of each node.

    Returns
    -------
    (M,) bool.
    """
    if len(links) == 0:
        return np.zeros(0, dtype=bool)
    confirmed = cycle_support(links, len(images)) > 0
    known = np.zeros(len(images), dtype=bool)
    known[links[confirmed].ravel()] = True
    doubtful = ~confirmed & known[links].any(axis=1)
    count = int(images.max()) + 1
    ends = images[links]
    keys, pair_of = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    excess = np.where(confirmed, 1.0, np.where(doubtful, -1.0, 0.0))
    pair_rule = np.bincount(pair_of, weights=excess, minlength=len(keys)) > 0
    image_rule = np.bincount(ends.ravel(), weights=np.repeat(excess, 2), minlength=count) > 0
    pairs = np.stack([keys // count, keys % count])
    part = components_of(count, pairs[:, pair_rule].T)
    rule = pair_rule | (image_rule[pairs].all(axis=0) & (part[pairs[0]] == part[pairs[1]]))
    return np.asarray(doubtful & rule[pair_of])
