"""Averaging of a filtered view graph; all edges, refused ones included, are then tested again."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationAverager, RotationGraph, edge_residuals
from snakesfm.rotation_averaging.irls import IrlsAverager
from snakesfm.rotation_averaging.moves import SEARCH_DEGREE, improve_rotations
from snakesfm.rotation_averaging.rejection import residual_limit
from snakesfm.view_graph.components import label_components
from snakesfm.view_graph.filters import keep_largest_component


def average_rotation_components(
    averager: RotationAverager,
    graph: RotationGraph,
    reasons: Array,
    smallest_limit_deg: float,
    largest_limit_deg: float,
    min_images: int,
) -> tuple[Array, Array, Array]:
    """Average the largest component of the kept edges, then of what that leaves the largest, and so on.

    What the judging of edges cuts off a component may so become one of its own.

    Parameters
    ----------
    graph, reasons, smallest_limit_deg, largest_limit_deg : as of :func:`average_view_graph`.
    min_images : images that a component must have; the first needs two.

    Returns
    -------
    rotations : (N,3,3) cam_from_world, each component in its own frame, NaN where there is none.
    reasons : (E,) str; ``rotation_residual`` and ``component`` where refused here.
    components : (N,) int32 of the images that have a rotation, 0 the first; -1 for others.
    """
    rotations = np.full((graph.node_count, 3, 3), np.nan)
    components = np.full(graph.node_count, -1, dtype=np.int32)
    judged = np.where(reasons == "kept", "component", reasons).astype(object)
    tried = np.zeros(graph.node_count, dtype=bool)
    while True:
        open_edges = ~tried[graph.pairs].any(axis=1)
        largest = label_components(graph.node_count, graph.pairs[open_edges & (reasons == "kept")]) == 0
        if np.count_nonzero(largest) < (min_images if tried.any() else 2):
            return rotations, judged, components
        inside = largest[graph.pairs].all(axis=1)
        averaged, left, labels = average_view_graph(
            averager, graph.restrict(largest), reasons[inside], smallest_limit_deg, largest_limit_deg
        )
        images = np.flatnonzero(largest)[labels == 0]
        if len(images) >= min_images or not tried.any():
            rotations[images] = averaged[labels == 0]
            judged[inside] = left
            components[images] = components.max() + 1
        tried[images] = True


def average_view_graph(
    averager: RotationAverager,
    graph: RotationGraph,
    reasons: Array,
    smallest_limit_deg: float,
    largest_limit_deg: float,
) -> tuple[Array, Array, Array]:
    """Average the kept edges, then take back refused ones that agree, and refuse kept ones that do not.

    What the filter refused has its say in between: the averaged rotations descend on the robust cost of all
    edges, so that a filter's wrong choices do no harm. Then the edges that are kept are averaged once more.

    Parameters
    ----------
    graph : all N images and E edges, of which the kept ones connect all.
    reasons : (E,) str, ``kept`` or what refused an edge.
    smallest_limit_deg, largest_limit_deg : bounds of the residual above which an edge is refused.

    Returns
    -------
    rotations : (N,3,3) cam_from_world, NaN outside of the largest component of the kept edges.
    reasons : (E,) str; ``rotation_residual`` and ``component`` where refused here.
    components : (N,) int32, 0 the largest.
    """

    def average(chosen: Array) -> Array:
        part = graph.subset(chosen)
        return averager.average(part.node_count, part.pairs, part.rotations, part.weights, part.covariances)

    kept = reasons == "kept"
    components = label_components(graph.node_count, graph.pairs[kept])
    rotations = average(kept)
    judging = rotations if kept.all() else _improve_on_all(graph, rotations)
    for last in (False, True):
        residuals = np.degrees(edge_residuals(graph.pairs, graph.rotations, judging))
        fits = residuals <= residual_limit(residuals[kept], smallest_limit_deg, largest_limit_deg)
        if not fits.any():
            # nothing agrees with anything: better some rotations, labelled by their residuals, than none
            break
        before = kept
        reasons = np.where(fits, "kept", np.where(kept, "rotation_residual", reasons)).astype(object)
        reasons, components = keep_largest_component(graph.node_count, graph.pairs, reasons)
        kept = reasons == "kept"
        if np.array_equal(kept, before) or last:
            break
        rotations = judging = average(kept)
    rotations[components != 0] = np.nan
    first = np.flatnonzero(components == 0)[0]
    return rotations @ rotations[first].T, reasons, components


def _improve_on_all(graph: RotationGraph, rotations: Array) -> Array:
    """Rotations (N,3,3) that suit all edges between nodes with a rotation better."""
    known = np.isfinite(rotations[:, 0, 0])
    part = graph.restrict(known).thin(SEARCH_DEGREE)
    improved = rotations.copy()
    improved[known] = improve_rotations(IrlsAverager(), part, rotations[known])
    return improved
