"""Clusters of cameras whose shape is known, joined by cameras that they share and by edges between them.

Landmarks compare baselines only where one is seen along several edges. Where photographs overlap little,
clusters are left that no landmark ties together. Their rotations are known, so each lacks but a scale and a
shift, which a loop of edges tells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.translation_averaging.landmarks import edge_angles_rad, perpendicular, usual_error_rad
from snakesfm.translation_averaging.problem import PositioningProblem

# edges are no better than this, and no better than those of the first cluster agree with its centres
LEAST_SIGMA_RAD = math.radians(0.3)
ROUNDS = 10
AGREEING_SIGMAS = 4.0
LARGEST_CONDITION = 1e14


def join_by_edges(
    problem: PositioningProblem, clusters: Sequence[Array], max_relative_sigma: float
) -> tuple[Array, list[Array]]:
    """Centres (N,3) of the first cluster and of all that shared cameras and edges tie to it; the others.

    Parameters
    ----------
    problem : its edges take part.
    clusters : (N,3) centres of each, in a scale and an origin of its own; NaN outside of the cluster.
    max_relative_sigma : standard deviation of a centre, over the distance to the neighbours that tell it,
        up to which a cluster is joined.
    """
    centers = clusters[0].copy()
    waiting = list(clusters[1:])
    sigma_rad = usual_error_rad(edge_angles_rad(problem, centers), LEAST_SIGMA_RAD)
    before = -1
    while before != len(waiting):
        before = len(waiting)
        left = []
        for cluster in waiting:
            placed = _place(problem, centers, cluster, sigma_rad, max_relative_sigma)
            if placed is None:
                left.append(cluster)
            else:
                centers = np.where(np.isfinite(centers), centers, placed)
        waiting = left
    return centers, waiting


@dataclass(frozen=True)
class _Ties:
    """What ties a cluster to known centres: K cameras that both have, then M edges.

    Parameters
    ----------
    places : (K+M,3) cameras of the cluster, in its own scale and origin.
    targets : (K+M,3) where a shared camera is, and the known ends of the edges.
    lines : (M,3) unit vectors from there to the cluster's ends.
    reach : (K,) usual length of a shared camera's edges.
    """

    places: Array
    targets: Array
    lines: Array
    reach: Array

    @classmethod
    def of(cls, problem: PositioningProblem, centers: Array, cluster: Array) -> "_Ties":
        """The ties of a cluster; of the shared cameras, those have some that have known neighbours."""
        known, mine = np.isfinite(centers[:, 0]), np.isfinite(cluster[:, 0])
        fresh = mine & ~known
        first, second = problem.pairs.T
        forth, back = known[first] & fresh[second], fresh[first] & known[second]
        lengths = np.linalg.norm(centers[second] - centers[first], axis=1)
        usual = {row: lengths[(problem.pairs == row).any(axis=1)] for row in np.flatnonzero(known & mine)}
        reach = {row: np.nanmedian(some) for row, some in usual.items() if np.isfinite(some).any()}
        shared = np.array(list(reach), dtype=np.int64)
        return cls(
            cluster[np.concatenate([shared, second[forth], first[back]])],
            centers[np.concatenate([shared, first[forth], second[back]])],
            np.concatenate([problem.directions[forth], -problem.directions[back]]),
            np.array(list(reach.values())),
        )

    def solve(self, sigma_rad: float) -> tuple[Array, Array, Array, float] | None:
        """Scale and shift (4,), their covariance (4,4), which ties (K+M,) agree, and a tie's usual length.

        Robust and by angles of ``sigma_rad``; None where the ties do not determine them.
        """
        count = len(self.reach)
        whole = np.broadcast_to(np.eye(3), (count, 3, 3))
        across = np.concatenate([whole, perpendicular(self.lines)])
        design = np.concatenate([across @ self.places[:, :, None], across], axis=2)
        right = np.einsum("rij,rj->ri", across, self.targets)
        reach = np.concatenate([self.reach, np.ones(len(self.lines))])
        robust, agree = np.ones(len(reach)), np.zeros(len(reach), dtype=bool)
        solution, information = np.zeros(4), np.eye(4)
        for _ in range(ROUNDS):
            weights = robust / (sigma_rad * reach) ** 2
            information = np.einsum("r,rik,ril->kl", weights, design, design)
            if not np.linalg.cond(information) < LARGEST_CONDITION:
                return None
            solution = np.linalg.solve(information, np.einsum("r,rik,ri->k", weights, design, right))
            offsets = solution[0] * self.places + solution[1:] - self.targets
            reach[count:] = np.maximum(np.linalg.norm(offsets[count:], axis=1), 1e-9)
            miss = np.linalg.norm(np.einsum("rij,rj->ri", across, offsets), axis=1) / (reach * sigma_rad)
            behind = np.zeros(len(reach), dtype=bool)
            behind[count:] = np.einsum("ri,ri->r", offsets[count:], self.lines) < 0
            robust = np.where(behind, 0.01, 1.0) / (1.0 + miss**2)
            agree = (miss < AGREEING_SIGMAS) & ~behind
        return solution, np.linalg.inv(information), agree, float(np.median(reach))


def _place(
    problem: PositioningProblem,
    centers: Array,
    cluster: Array,
    sigma_rad: float,
    max_relative_sigma: float,
) -> Array | None:
    """A cluster scaled and shifted to the known centres, or None where these do not tell how."""
    fresh = cluster[np.isfinite(cluster[:, 0]) & ~np.isfinite(centers[:, 0])]
    ties = _Ties.of(problem, centers, cluster)
    if not len(fresh) or 3 * len(ties.reach) + 2 * len(ties.lines) <= 4:
        return None
    solved = ties.solve(sigma_rad)
    if solved is None:
        return None
    solution, covariance, agree, usual = solved
    moves = np.concatenate([fresh[:, :, None], np.broadcast_to(np.eye(3), (len(fresh), 3, 3))], axis=2)
    sigmas = np.sqrt(np.linalg.eigvalsh(moves @ covariance @ moves.transpose(0, 2, 1))[:, 2])
    equations = np.concatenate([np.full(len(ties.reach), 3), np.full(len(ties.lines), 2)])
    # any two edges meet four unknowns exactly, so only what is left over confirms them
    firm = solution[0] > 0 and equations[agree].sum() - 4 >= equations[~agree].sum()
    if not firm or (sigmas > max_relative_sigma * usual).any():
        return None
    return np.asarray(solution[0] * cluster + solution[1:])
