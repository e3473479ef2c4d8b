"""The error of each edge, from messages that its 3-cycles pass between their edges."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.view_graph.cycles import Cycles

SHARPNESS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 64.0)
"""Per round, how fast a cycle loses its say with the errors (in half turns) of its two other edges."""


def edge_errors(edge_count: int, cycles: Cycles, weights: Array) -> Array:
    """Estimate the rotation error (E,) in radians of every edge, NaN in no cycle.

    An edge's error is the mean error of its cycles, each weighed by how right its two other edges seem and
    by their ``weights`` (E,), such as inlier counts. Seeming right is refined from round to round.

    References
    ----------
    Lerman and Shi, Robust Group Synchronization via Cycle-Edge Message Passing, FoCM 2022; the weights by
    inlier counts are ours.
    """
    half_turns = cycles.errors.astype(np.float64) / np.pi
    trust = np.log(np.maximum(weights, 1.0))
    errors = np.zeros(edge_count)
    totals = np.zeros(edge_count)
    for sharpness in SHARPNESS:
        sums, totals = np.zeros(edge_count), np.zeros(edge_count)
        exponents = trust - sharpness * errors
        # sums of exponentials are relative to the largest, which keeps them from vanishing all together
        exponents -= exponents.max(initial=0.0)
        for owner, first, second in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
            owners = cycles.edges[:, owner]
            votes = np.exp(exponents[cycles.edges[:, first]] + exponents[cycles.edges[:, second]])
            sums += np.bincount(owners, votes * half_turns, edge_count)
            totals += np.bincount(owners, votes, edge_count)
        errors = np.where(totals > 0, sums / np.maximum(totals, np.finfo(float).tiny), 1.0)
    return np.where(totals > 0, errors * np.pi, np.nan)
