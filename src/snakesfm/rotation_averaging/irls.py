"""Robust averaging by iteratively reweighted least squares on the tangent spaces."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationAverager, RotationGraph
from snakesfm.rotation_averaging.linear import apply_increments, solve_isotropic, world_residuals
from snakesfm.rotation_averaging.tree import tree_rotations

SMALLEST_RAD = np.radians(0.01)
"""Residuals below this have the same weight in the L1 steps, which would be unbounded otherwise."""

CONVERGED_RAD = np.radians(0.01)
"""Steps end when no rotation moves by more."""


@dataclass(frozen=True)
class IrlsAverager(RotationAverager):
    """L1 and then Geman-McClure reweighted least squares from a maximum spanning tree.

    Parameters
    ----------
    scale_rad : residual at which the Geman-McClure loss lets go.
    l1_iterations, iterations : at most so many steps of each kind.

    References
    ----------
    Chatterjee and Govindu, Robust Relative Rotation Averaging, PAMI 2018; the roots of the weights are
    ours.
    """

    scale_rad: float = float(np.radians(5.0))
    l1_iterations: int = 15
    iterations: int = 30

    def solve(self, graph: RotationGraph) -> Array:
        """Rotations (N,3,3) of a connected graph."""
        start = tree_rotations(graph.node_count, graph.pairs, graph.rotations, 1.0 / graph.weights)
        return self.descend(graph, self.straighten(graph, start))

    def straighten(self, graph: RotationGraph, start: Array) -> Array:
        """L1 steps from ``start`` (N,3,3), blind to the weights, so that no strong outlier wins."""
        averaged = start
        for _ in range(self.l1_iterations):
            residuals = world_residuals(graph.pairs, graph.rotations, averaged)
            weights = 1.0 / np.maximum(np.linalg.norm(residuals, axis=1), SMALLEST_RAD)
            increments = solve_isotropic(graph.node_count, graph.pairs, weights, residuals)
            averaged = apply_increments(averaged, increments)
            if np.linalg.norm(increments, axis=1).max() < 10.0 * CONVERGED_RAD:
                break
        return averaged

    def descend(self, graph: RotationGraph, start: Array) -> Array:
        """Geman-McClure steps from ``start`` (N,3,3), with the roots of the edges' weights."""
        trust = np.sqrt(graph.weights / np.median(graph.weights))
        averaged = start
        for _ in range(self.iterations):
            residuals = world_residuals(graph.pairs, graph.rotations, averaged)
            squares = np.sum(residuals**2, axis=1) / self.scale_rad**2
            increments = solve_isotropic(
                graph.node_count, graph.pairs, trust / (1.0 + squares) ** 2, residuals
            )
            averaged = apply_increments(averaged, increments)
            if np.linalg.norm(increments, axis=1).max() < CONVERGED_RAD:
                break
        return averaged

    def cost(self, graph: RotationGraph, averaged: Array) -> float:
        """What :meth:`descend` minimises."""
        residuals = world_residuals(graph.pairs, graph.rotations, averaged)
        squares = np.sum(residuals**2, axis=1) / self.scale_rad**2
        return float(np.sum(np.sqrt(graph.weights) * squares / (1.0 + squares)))
