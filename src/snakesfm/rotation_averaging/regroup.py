"""Re-joining of groups of rotations that are connected by single edges, by a vote of all edges."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationGraph, edge_residuals
from snakesfm.rotation_averaging.clusters import join_by_votes
from snakesfm.view_graph.bridges import find_bridges


def regroup_nodes(graph: RotationGraph, averaged: Array, tolerance_rad: float) -> Array:
    """Rotations in which groups of nodes are joined by the relative rotation that most weight agrees on.

    The groups are what the edges that fit hold together in cycles: a single wrong edge that fits can hold a
    whole group in a wrong place, against several right edges that do not fit there.

    Parameters
    ----------
    averaged : (N,3,3).
    tolerance_rad : edges with smaller residuals fit, and votes that differ by less agree.

    Returns
    -------
    (N,3,3), rough rotations to descend from.
    """
    holding = edge_residuals(graph.pairs, graph.rotations, averaged) < tolerance_rad
    rows = np.flatnonzero(holding)
    holding[rows[find_bridges(graph.node_count, graph.pairs[rows])]] = False
    votes = np.sqrt(graph.weights)
    return join_by_votes(graph.node_count, graph.pairs, graph.rotations, votes, holding, tolerance_rad)[1]
