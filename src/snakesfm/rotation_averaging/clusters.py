"""Clusters of images connected by cycles, and the votes by which they are joined."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import angle_of
from snakesfm.rotation_averaging.irls import IrlsAverager
from snakesfm.view_graph.components import label_components

VOTES_AT_ONCE = 1000
"""Votes that are compared with all others of their two clusters at once."""

LOOSE = 3.0
"""Edges without a cycle may differ from rough rotations by so many tolerances: those drift along chains."""


def vote_between_clusters(
    node_count: int,
    pairs: Array,
    rotations: Array,
    inlier_counts: Array,
    reasons: Array,
    confirmed: Array,
    min_inliers: int,
    tolerance_rad: float,
) -> Array:
    """Join what the cycles left apart, and refuse what contradicts the joins.

    Images that are held together by confirmed edges of at least ``min_inliers`` inliers form clusters. All
    other edges between clusters vote on how to join them, those that cycles refused included: a right edge
    between two groups of images is often in wrong cycles only, and a few wrong edges of few inliers often
    confirm each other.

    Parameters
    ----------
    reasons : (E,) str, of the cycle filter.
    confirmed : (E,) bool, edges that the cycle filter kept and that are in a cycle.
    min_inliers : confirmed edges of fewer inliers hold no cluster together, but vote.
    tolerance_rad : votes that differ by less agree.

    Returns
    -------
    (E,) str, the reasons after the vote; the kept edges connect all that any edges connect.
    """
    core = confirmed & (inlier_counts >= min_inliers)
    clusters = label_components(node_count, pairs[core])
    inside = clusters[pairs[:, 0]] == clusters[pairs[:, 1]]
    if inside.all() and confirmed[reasons == "kept"].all():
        return reasons
    weights = inlier_counts.astype(np.float64)
    joining, frames = join_by_votes(node_count, pairs, rotations, weights, core, tolerance_rad)
    heads, tails = frames[pairs[:, 0]], frames[pairs[:, 1]]
    residuals = angle_of(tails.transpose(0, 2, 1) @ rotations @ heads)
    fitting = residuals <= np.where(confirmed, 1.0, LOOSE) * tolerance_rad
    kept = joining | ((reasons == "kept") & (fitting | (inside & confirmed)))
    return np.where(kept, "kept", np.where(reasons == "kept", "cluster_vote", reasons)).astype(object)


def join_by_votes(
    node_count: int, pairs: Array, rotations: Array, weights: Array, trusted: Array, tolerance_rad: float
) -> tuple[Array, Array]:
    """Choose the edges that join clusters: those that most of the inlier matches agree on.

    The components of the trusted edges are clusters with rotations of their own. Every other edge between
    two clusters votes, with its weight, for one rotation between them. The best supported joins are carried
    out first; votes of several clusters then count together.

    Parameters
    ----------
    node_count : N.
    pairs : (E,2) int, sorted and unique.
    rotations : (E,3,3) float64, j_from_i.
    weights : (E,) float64, weight of each vote, such as the inlier count.
    trusted : (E,) bool, edges that cycles confirm.
    tolerance_rad : votes that differ by less agree.

    Returns
    -------
    joining : (E,) bool, the edges that joined clusters. The components of these and the trusted edges are
        those of all edges.
    frames : (N,3,3) float64, rough cam_from_world rotations, one gauge per component.
    """
    joining = np.zeros(len(pairs), dtype=bool)
    clusters = label_components(node_count, pairs[trusted]).astype(np.int64)
    frames = _cluster_rotations(node_count, pairs, rotations, weights, trusted, clusters)
    rounds = 0
    while True:
        open_edges = np.flatnonzero(clusters[pairs[:, 0]] != clusters[pairs[:, 1]])
        if len(open_edges) == 0:
            return joining, frames
        heads, tails = pairs[open_edges].T
        # of the smaller cluster's frame to the larger one's, so that all votes of a pair compare
        votes = frames[tails].transpose(0, 2, 1) @ rotations[open_edges] @ frames[heads]
        first, second = clusters[heads], clusters[tails]
        flipped = first > second
        votes = np.where(flipped[:, None, None], votes.transpose(0, 2, 1), votes)
        low, high = np.minimum(first, second), np.maximum(first, second)
        supports = _supports(low * node_count + high, votes, weights[open_edges], tolerance_rad)
        winners = _mutually_best(low, high, supports, node_count, greedy=rounds >= 30)
        for winner in winners:
            if clusters[heads[winner]] == clusters[tails[winner]]:
                continue
            same = (low == low[winner]) & (high == high[winner])
            apart = angle_of(votes[winner].T @ votes[same])
            joining[open_edges[same][apart <= tolerance_rad]] = True
            _merge(clusters, frames, heads[winner], tails[winner], rotations[open_edges[winner]])
        rounds += 1


def _cluster_rotations(
    node_count: int, pairs: Array, rotations: Array, weights: Array, trusted: Array, clusters: Array
) -> Array:
    """Rotations (N,3,3) of every image in the frame of its cluster."""
    frames = np.tile(np.eye(3), (node_count, 1, 1))
    averager = IrlsAverager()
    owners = clusters[pairs[:, 0]]
    for cluster in range(int(np.count_nonzero(np.bincount(clusters) > 1))):
        chosen = trusted & (owners == cluster)
        members = clusters == cluster
        averaged = averager.average(node_count, pairs[chosen], rotations[chosen], weights[chosen])
        frames[members] = averaged[members]
    return frames


def _supports(keys: Array, votes: Array, weights: Array, tolerance_rad: float) -> Array:
    """Weight (V,) of the votes of the same key that agree with each vote."""
    order = np.argsort(keys, kind="stable")
    _, starts, counts = np.unique(keys[order], return_index=True, return_counts=True)
    supports = weights.astype(np.float64)
    # the trace of a.T @ b, which is the product of their entries, is 1 + 2 cos(angle)
    entries, least_trace = votes.reshape(-1, 9), 1.0 + 2.0 * np.cos(tolerance_rad)
    for start, count in zip(starts[counts > 1], counts[counts > 1], strict=True):
        rows = order[start : start + count]
        for some in np.array_split(rows, -(-count // VOTES_AT_ONCE)):
            agree = entries[some] @ entries[rows].T >= least_trace
            supports[some] = agree @ weights[rows]
    return supports


def _mutually_best(low: Array, high: Array, supports: Array, node_count: int, greedy: bool) -> Array:
    """Votes that are the best of both their clusters, or of one where ``greedy``, best first."""
    order = np.lexsort((high, low, -supports))
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.arange(len(order))
    best = np.full(node_count, len(order), dtype=np.int64)
    np.minimum.at(best, low, ranks)
    np.minimum.at(best, high, ranks)
    is_best = (best[low] == ranks).astype(int) + (best[high] == ranks)
    chosen: Array = order[(is_best >= (1 if greedy else 2))[order]]
    return chosen


def _merge(clusters: Array, frames: Array, head: int, tail: int, rotation: Array) -> None:
    """Take the smaller cluster of an edge into the larger one, in place."""
    sizes = np.count_nonzero(clusters == clusters[head]), np.count_nonzero(clusters == clusters[tail])
    if sizes[0] >= sizes[1]:
        keep, move, target = clusters[head], clusters[tail], rotation @ frames[head]
        turn = frames[tail].T @ target
    else:
        keep, move, target = clusters[tail], clusters[head], rotation.T @ frames[tail]
        turn = frames[head].T @ target
    moved = clusters == move
    frames[moved] = frames[moved] @ turn
    clusters[moved] = keep
