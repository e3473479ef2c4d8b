"""Single rotations that most of their edges contradict, moved to where more edges agree."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationGraph

CHUNK = 1 << 20
"""Candidate and edge combinations that are held in memory at once."""

LEAST_GAIN = 0.05
"""Part of a node's cost that a move must save."""


def reseat_nodes(graph: RotationGraph, averaged: Array, scale_rad: float) -> Array:
    """Move nodes to the best of the rotations that their edges propose, neighbours never together.

    Reweighted least squares ends in local minima where a few nodes follow an outlier; this leaves them.

    Parameters
    ----------
    averaged : (N,3,3).
    scale_rad : of the Geman-McClure cost that decides.

    Returns
    -------
    (N,3,3); the same where no node gains.
    """
    heads, tails = graph.pairs.T
    nodes = np.concatenate([heads, tails])
    order = np.argsort(nodes, kind="stable")
    nodes = nodes[order]
    edges = np.tile(np.arange(len(heads)), 2)[order]
    others = np.concatenate([tails, heads])[order]
    steps = graph.rotations[edges]
    steps = np.where((nodes == heads[edges])[:, None, None], steps.transpose(0, 2, 1), steps)
    proposals = steps @ averaged[others]
    weights = np.sqrt(graph.weights[edges])
    counts = np.bincount(nodes, minlength=graph.node_count)
    starts = np.cumsum(counts) - counts
    costs = _proposal_costs(proposals, weights, nodes, counts, starts, scale_rad)
    now = np.bincount(nodes, weights * _losses(proposals, averaged[nodes], scale_rad), graph.node_count)
    gains = now - np.minimum.reduceat(costs, starts)
    around = np.zeros(graph.node_count)
    np.maximum.at(around, nodes, gains[others])
    moved = averaged.copy()
    for node in np.flatnonzero((gains > LEAST_GAIN * now) & (gains > np.maximum(around, 1e-9))):
        own = slice(starts[node], starts[node] + counts[node])
        moved[node] = proposals[own][np.argmin(costs[own])]
    return moved


def _proposal_costs(
    proposals: Array, weights: Array, nodes: Array, counts: Array, starts: Array, scale_rad: float
) -> Array:
    """Cost (P,) that a node would have at each of its proposals, P = 2E."""
    costs = np.empty(len(proposals))
    totals = np.cumsum(counts[nodes])
    start = 0
    while start < len(proposals):
        done = totals[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(totals, done + CHUNK, side="right")))
        sizes = counts[nodes[start:stop]]
        rows = np.repeat(np.arange(start, stop), sizes)
        offsets = np.arange(len(rows)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        peers = starts[nodes[rows]] + offsets
        losses = weights[peers] * _losses(proposals[rows], proposals[peers], scale_rad)
        costs[start:stop] = np.bincount(rows - start, losses, stop - start)
        start = stop
    return costs


def _losses(first: Array, second: Array, scale_rad: float) -> Array:
    """Geman-McClure losses (K,) of the angles between rotations (K,3,3)."""
    cosines = 0.5 * (np.einsum("kab,kab->k", first, second) - 1.0)
    squares = np.arccos(np.clip(cosines, -1.0, 1.0)) ** 2 / scale_rad**2
    losses: Array = squares / (1.0 + squares)
    return losses
