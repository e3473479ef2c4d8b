"""A robust search, then a refinement weighted by covariances."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import log_so3
from snakesfm.rotation_averaging.base import RotationAverager, RotationGraph
from snakesfm.rotation_averaging.irls import IrlsAverager
from snakesfm.rotation_averaging.linear import apply_increments, solve_anisotropic, world_residuals
from snakesfm.rotation_averaging.moves import CLEAN, SEARCH_DEGREE, contradicted_share, improve_rotations
from snakesfm.rotation_averaging.noise import fill_covariances, fit_noise, squared_lengths, student_weights
from snakesfm.rotation_averaging.rejection import contradiction, residual_limit
from snakesfm.rotation_averaging.tree import tree_rotations
from snakesfm.view_graph.cycles import find_cycles
from snakesfm.view_graph.messages import edge_errors

REFUSED = 1e-6
"""Weight of refused edges: none in effect, but the graph stays connected."""


@dataclass(frozen=True)
class TwoStageAverager(RotationAverager):
    """Robust averaging blind to covariances, then maximum likelihood with them on the edges that fit.

    A confident outlier spoils a single pass with covariances; after the robust stage it is refused. That
    stage starts from two spanning trees, by inlier counts and by cycle messages, moves single nodes and
    weakly connected groups out of local minima and keeps the result that most inlier matches agree with.
    The covariances are rescaled and floored as the residuals demand; where there is none, the inlier
    count stands in.

    Parameters
    ----------
    robust : steps of the first stage.
    smallest_limit_rad, largest_limit_rad : bounds of the residual at which an edge is refused.
    rounds : how often the noise model is fitted.
    iterations : linear steps per round, at most.
    """

    robust: IrlsAverager = field(default_factory=IrlsAverager)
    smallest_limit_rad: float = float(np.radians(8.0))
    largest_limit_rad: float = float(np.radians(20.0))
    rounds: int = 3
    iterations: int = 5

    def solve(self, graph: RotationGraph) -> Array:
        """Rotations (N,3,3) of a connected graph."""
        averaged = self._search(graph)
        for _ in range(self.rounds):
            averaged = self._refine(graph, averaged)
        return averaged

    def _search(self, graph: RotationGraph) -> Array:
        """Rotations of the start that most inlier matches agree with in the end."""
        graph = graph.thin(SEARCH_DEGREE)
        best, best_cost = np.zeros((0, 3, 3)), np.inf
        for start in self._starts(graph):
            averaged = improve_rotations(self.robust, graph, self.robust.straighten(graph, start))
            cost = contradiction(graph, averaged, self.robust.scale_rad)
            if cost < best_cost:
                best, best_cost = averaged, cost
            if contradicted_share(self.robust, graph, best) <= CLEAN:
                break
        return best

    def _starts(self, graph: RotationGraph) -> Iterator[Array]:
        """Rotations along spanning trees of the edges that their cycles confirm.

        First the tree of most inliers: edges of repeated structure confirm each other, but have fewer. Then
        the tree of least error by cycle messages.
        """
        cycles = find_cycles(graph.node_count, graph.pairs, graph.rotations)
        unverified = np.where(np.isnan(cycles.smallest), 0.5, cycles.smallest > self.robust.scale_rad)
        costs = graph.weights.min() / graph.weights + unverified
        yield tree_rotations(graph.node_count, graph.pairs, graph.rotations, costs)
        errors = edge_errors(len(graph.pairs), cycles, graph.weights)
        unknown = np.radians(20.0)
        noise = np.radians(0.5) * np.sqrt(np.median(graph.weights) / graph.weights)
        costs = np.where(np.isnan(errors), unknown, errors) + noise
        yield tree_rotations(graph.node_count, graph.pairs, graph.rotations, costs)

    def _refine(self, graph: RotationGraph, averaged: Array) -> Array:
        """Maximum likelihood rotations near ``averaged`` under Student t noise."""
        tails = averaged[graph.pairs[:, 1]]
        # residuals as left increments of j_from_i, in the frame of camera j, where the covariances are
        local = log_so3(graph.rotations @ averaged[graph.pairs[:, 0]] @ tails.transpose(0, 2, 1))
        angles = np.linalg.norm(local, axis=1)
        fits = angles <= residual_limit(angles, self.smallest_limit_rad, self.largest_limit_rad)
        if np.count_nonzero(fits) < graph.node_count:
            return averaged
        given = fill_covariances(graph.covariances[fits], graph.weights[fits])
        information = np.tile(np.eye(3), (len(fits), 1, 1))
        information[fits] = np.linalg.inv(fit_noise(local[fits], given))
        information[~fits] *= REFUSED * np.median(information[fits, 0, 0])
        for _ in range(self.iterations):
            residuals = world_residuals(graph.pairs, graph.rotations, averaged)
            tails = averaged[graph.pairs[:, 1]]
            turned = tails.transpose(0, 2, 1) @ information @ tails
            weights = student_weights(squared_lengths(residuals, turned))
            increments = solve_anisotropic(
                graph.node_count, graph.pairs, weights[:, None, None] * turned, residuals
            )
            averaged = apply_increments(averaged, increments)
            if np.linalg.norm(increments, axis=1).max() < 1e-4:
                break
        return averaged
