"""Leaving local minima: descent in turns with moves of single nodes and of weakly connected groups."""

from collections.abc import Callable

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationGraph, edge_residuals
from snakesfm.rotation_averaging.irls import IrlsAverager
from snakesfm.rotation_averaging.regroup import regroup_nodes
from snakesfm.rotation_averaging.reseat import reseat_nodes

Move = Callable[[RotationGraph, Array, float], Array]

MOVES = 3
"""So often nodes are reseated or regrouped, at most."""

CLEAN = 0.03
"""Part of the edges that may contradict rotations for these to be taken as they are."""

SEARCH_DEGREE = 60
"""Edges per node that take part in a search; all of them take part in what follows."""

LEAST_FALL = 1e-4
"""Part of the cost that a move must save."""


def improve_rotations(robust: IrlsAverager, graph: RotationGraph, averaged: Array) -> Array:
    """Rotations (N,3,3) of least robust cost near ``averaged`` (N,3,3), or near moves from there."""
    averaged = robust.descend(graph, averaged)
    averaged = _repeat(robust, graph, averaged, reseat_nodes, robust.scale_rad)
    if contradicted_share(robust, graph, averaged) > CLEAN:
        averaged = _repeat(robust, graph, averaged, regroup_nodes, 2.0 * robust.scale_rad)
    return averaged


def contradicted_share(robust: IrlsAverager, graph: RotationGraph, averaged: Array) -> float:
    """Share of the edges that do not fit."""
    angles = edge_residuals(graph.pairs, graph.rotations, averaged)
    return float(np.mean(angles > 2.0 * robust.scale_rad))


def _repeat(
    robust: IrlsAverager, graph: RotationGraph, averaged: Array, move: Move, scale_rad: float
) -> Array:
    cost = robust.cost(graph, averaged)
    for _ in range(MOVES):
        moved = robust.descend(graph, move(graph, averaged, scale_rad))
        moved_cost = robust.cost(graph, moved)
        if moved_cost >= (1.0 - LEAST_FALL) * cost:
            break
        averaged, cost = moved, moved_cost
    return averaged
