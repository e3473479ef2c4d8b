"""The interface of rotation averagers, and code that they share."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import SceneError
from snakesfm.geometry.rotations import angle_of
from snakesfm.view_graph.components import label_components


@dataclass(frozen=True)
class RotationGraph:
    """A connected graph of relative rotations whose nodes are 0 .. node_count-1.

    Parameters
    ----------
    node_count : N >= 2.
    pairs : (E,2) int64, edges i < j, sorted and unique.
    rotations : (E,3,3) float64, j_from_i.
    weights : (E,) float64 > 0, trust in each edge, such as its inlier count.
    covariances : (E,3,3) float64 in rad^2 of the left increment of j_from_i; NaN where unknown.
    """

    node_count: int
    pairs: Array
    rotations: Array
    weights: Array
    covariances: Array

    def subset(self, chosen: Array) -> "RotationGraph":
        """The same nodes with the ``chosen`` (E,) bool edges only."""
        return RotationGraph(
            self.node_count,
            self.pairs[chosen],
            self.rotations[chosen],
            self.weights[chosen],
            self.covariances[chosen],
        )

    def restrict(self, nodes: Array) -> "RotationGraph":
        """Some ``nodes`` (N,) bool, numbered from 0 in their order, with the edges between them."""
        part = self.subset(np.asarray(nodes[self.pairs].all(axis=1)))
        numbers = np.cumsum(nodes) - 1
        return replace(part, node_count=int(np.count_nonzero(nodes)), pairs=numbers[part.pairs])

    def thin(self, degree: int) -> "RotationGraph":
        """The graph with about ``degree`` evenly spaced edges at every node that has more, if connected."""
        ends = self.pairs.ravel()
        order = np.argsort(ends, kind="stable")
        counts = np.bincount(ends, minlength=self.node_count)
        if counts.max() <= degree:
            return self
        places = np.arange(len(ends)) - np.repeat(np.cumsum(counts) - counts, counts)
        many = np.repeat(counts, counts)
        # the edge at a place is kept where its even spacing steps over an integer
        stays = (places * degree) // many != ((places + 1) * degree) // many
        chosen = np.zeros(len(self.pairs), dtype=bool)
        chosen[order[(many <= degree) | stays] // 2] = True
        thinned = self.subset(chosen)
        return thinned if label_components(self.node_count, thinned.pairs).max() == 0 else self


class RotationAverager(ABC):
    """Averages relative rotations to absolute ones."""

    def average(
        self,
        node_count: int,
        pairs: Array,
        rotations: Array,
        weights: Array | None = None,
        covariances: Array | None = None,
    ) -> Array:
        """Average the largest connected component.

        Parameters
        ----------
        node_count : N.
        pairs : (E,2) int, edges i < j, sorted and unique.
        rotations : (E,3,3) float64, j_from_i.
        weights : (E,) trust in each edge, such as its inlier count; uniform if None.
        covariances : (E,3,3) rad^2, of the left increment of j_from_i; NaN or None where unknown.

        Returns
        -------
        (N,3,3) float64 cam_from_world, the identity at the first node of the largest component and NaN
        outside it.

        Raises
        ------
        SceneError : there is no edge.
        ValueError : the pairs are no valid edges, or a rotation is not finite.
        """
        pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        rotations = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
        _check(node_count, pairs, rotations)
        inside = label_components(node_count, pairs) == 0
        graph = RotationGraph(
            node_count,
            pairs,
            rotations,
            np.ones(len(pairs)) if weights is None else np.maximum(weights, 1e-6),
            np.full((len(pairs), 3, 3), np.nan) if covariances is None else covariances,
        )
        solved = self.solve(graph.restrict(inside))
        averaged = np.full((node_count, 3, 3), np.nan)
        averaged[inside] = solved @ solved[0].T
        averaged[np.flatnonzero(inside)[0]] = np.eye(3)
        return averaged

    @abstractmethod
    def solve(self, graph: RotationGraph) -> Array:
        """Rotations (N,3,3) of a connected graph, cam_from_world in any gauge."""


def edge_residuals(pairs: Array, rotations: Array, averaged: Array) -> Array:
    """Angles (E,) in radians of R_j R_i^T to the edges' j_from_i; NaN where a node has no rotation."""
    heads, tails = averaged[pairs[:, 0]], averaged[pairs[:, 1]]
    known = np.isfinite(heads[:, 0, 0]) & np.isfinite(tails[:, 0, 0])
    residuals = np.full(len(pairs), np.nan)
    if known.any():
        composed = tails[known].transpose(0, 2, 1) @ rotations[known] @ heads[known]
        residuals[known] = angle_of(composed)
    return residuals


def _check(node_count: int, pairs: Array, rotations: Array) -> None:
    if len(pairs) == 0:
        raise SceneError("The view graph has no edge to average: see why filter_view_graph refused all.")
    if len(rotations) != len(pairs):
        raise ValueError(f"{len(pairs)} pairs but {len(rotations)} rotations")
    if pairs.min() < 0 or pairs.max() >= node_count:
        raise ValueError(f"a pair names a node outside 0 .. {node_count - 1}")
    if (pairs[:, 0] >= pairs[:, 1]).any():
        raise ValueError("a pair (i, j) does not have i < j")
    if not np.isfinite(rotations).all():
        raise ValueError("a relative rotation is not finite")
