"""Filters of a view graph: which edges are refused, and by what."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.view_graph.components import label_components
from snakesfm.view_graph.cycles import Cycles, median_of, smallest_of

Array = NDArray[Any]

LOOSE = 3.0
"""Edges without a cycle may differ from rough rotations by so many tolerances: those drift along chains."""


def refuse_by_cycles(
    edge_count: int, cycles: Cycles, first_pass: str, second_pass: str, max_error_rad: float
) -> Array:
    """The filter of the paper: the smallest, then the median error of each edge's 3-cycles.

    Parameters
    ----------
    first_pass, second_pass : ``min``, ``median`` or ``none``; the second sees the survivors' cycles only.
    max_error_rad : larger errors refuse an edge.

    Returns
    -------
    (E,) str, ``cycle_min`` or ``cycle_median`` where refused, else ``kept``; an edge in no cycle is kept.
    """
    reasons = np.full(edge_count, "kept", dtype=object)
    for statistic in (first_pass, second_pass):
        alive = reasons == "kept"
        if statistic == "min":
            errors = cycles.smallest if alive.all() else smallest_of(edge_count, cycles, alive)
        elif statistic == "median":
            errors = median_of(edge_count, cycles, alive)
        else:
            continue
        reasons[alive & (errors > max_error_rad)] = f"cycle_{statistic}"
    return reasons


def refuse_by_messages(
    edge_count: int, cycles: Cycles, inlier_counts: Array, max_error_rad: float
) -> Array:
    """Refuse edges whose error, estimated by message passing between cycles, is too large.

    Returns
    -------
    (E,) str, ``cycle_message`` where refused, else ``kept``; an edge in no cycle is kept.
    """
    from snakesfm.view_graph.messages import edge_errors

    errors = edge_errors(edge_count, cycles, inlier_counts)
    return np.where(errors > max_error_rad, "cycle_message", "kept").astype(object)


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
    from snakesfm.geometry.rotations import angle_of
    from snakesfm.view_graph.clusters import join_clusters

    weights = inlier_counts.astype(np.float64)
    joining, frames = join_clusters(node_count, pairs, rotations, weights, core, tolerance_rad)
    heads, tails = frames[pairs[:, 0]], frames[pairs[:, 1]]
    residuals = angle_of(tails.transpose(0, 2, 1) @ rotations @ heads)
    fitting = residuals <= np.where(confirmed, 1.0, LOOSE) * tolerance_rad
    kept = joining | ((reasons == "kept") & (fitting | (inside & confirmed)))
    return np.where(kept, "kept", np.where(reasons == "kept", "cluster_vote", reasons)).astype(object)


def keep_largest_component(node_count: int, pairs: Array, reasons: Array) -> tuple[Array, Array]:
    """Refuse kept edges outside the largest component.

    Returns
    -------
    reasons : (E,) str, ``component`` where refused here.
    components : (N,) int32, component of every image by the edges that were kept, 0 the largest.
    """
    kept = reasons == "kept"
    components = label_components(node_count, pairs[kept])
    outside = kept & (components[pairs[:, 0]] != 0)
    return np.where(outside, "component", reasons).astype(object), components
