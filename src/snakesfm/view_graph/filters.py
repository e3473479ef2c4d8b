"""Filters of a view graph: which edges are refused, and by what."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.view_graph.components import label_components
from snakesfm.view_graph.cycles import Cycles, median_of, smallest_of
from snakesfm.view_graph.messages import edge_errors


def refuse_by_cycles(
    edge_count: int, cycles: Cycles, first_pass: str, second_pass: str, max_error_rad: float
) -> Array:
    """The filter of GTSfM: the smallest, then the median error of each edge's 3-cycles.

    Parameters
    ----------
    edge_count : E.
    cycles : 3-cycles of the E edges, with their errors in radians.
    first_pass, second_pass : ``min``, ``median`` or ``none``; the second sees the survivors' cycles only.
    max_error_rad : larger errors refuse an edge.

    Returns
    -------
    (E,) str, ``cycle_min`` or ``cycle_median`` where refused, else ``kept``; an edge in no cycle is kept.

    Source: Baid et al., Distributed Global Structure-from-Motion with a Deep Front-End, arXiv 2311.18801.
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

    The estimate and its source: see :func:`snakesfm.view_graph.messages.edge_errors`.

    Parameters
    ----------
    edge_count : E.
    cycles : 3-cycles of the E edges, with their errors in radians.
    inlier_counts : (E,) inlier matches of each edge.
    max_error_rad : larger errors refuse an edge.

    Returns
    -------
    (E,) str, ``cycle_message`` where refused, else ``kept``; an edge in no cycle is kept.
    """
    errors = edge_errors(edge_count, cycles, inlier_counts)
    return np.where(errors > max_error_rad, "cycle_message", "kept").astype(object)


def keep_largest_component(node_count: int, pairs: Array, reasons: Array) -> tuple[Array, Array]:
    """Refuse kept edges outside the largest component.

    Parameters
    ----------
    node_count : number N of images.
    pairs : (E,2) int, images of each edge.
    reasons : (E,) str, ``kept`` or what refused the edge before.

    Returns
    -------
    reasons : (E,) str, ``component`` where refused here.
    components : (N,) int32, component of every image by the edges that were kept, 0 the largest.
    """
    kept = reasons == "kept"
    components = label_components(node_count, pairs[kept])
    outside = kept & (components[pairs[:, 0]] != 0)
    return np.where(outside, "component", reasons).astype(object), components
