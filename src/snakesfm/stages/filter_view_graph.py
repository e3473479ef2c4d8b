"""Refuse edges of the view graph that contradict the others."""

import dataclasses
import sys
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import EDGE_LABELS, ViewGraph
from snakesfm.rotation_averaging.clusters import vote_between_clusters
from snakesfm.stages.job import StageJob
from snakesfm.view_graph.components import label_components
from snakesfm.view_graph.cycles import Cycles, find_cycles, median_of
from snakesfm.view_graph.filters import refuse_by_cycles, refuse_by_messages

if TYPE_CHECKING:
    from snakesfm.config.filter_view_graph import FilterViewGraphOptions


def run(job: StageJob) -> None:
    """Read the view graph, write it with the edges' labels, cycle errors and components."""
    options: FilterViewGraphOptions = job.options
    with ImageIndex.open(job.path("index")) as file:
        image_count = len(file["names"])
    graph = ViewGraph.read(job.path("graph"))
    edge_count = len(graph.pairs)
    cycles = find_cycles(image_count, graph.pairs, graph.rotations)
    reasons = refuse_edges(image_count, graph.pairs, graph.rotations, graph.inlier_counts, cycles, options)
    components = label_components(image_count, graph.pairs[reasons == "kept"])
    labels = np.array([EDGE_LABELS.index(reason) for reason in reasons], dtype=np.int8)
    dataclasses.replace(
        graph,
        labels=labels,
        cycle_min_deg=np.degrees(cycles.smallest),
        cycle_median_deg=np.degrees(median_of(edge_count, cycles, np.ones(edge_count, dtype=bool))),
        components=components,
    ).write(job.output, job.header)
    told = _cycles_tell(cycles, options)
    few = "" if told else f"; {cycles.per_edge:.1f} 3-cycles per edge are too few to refuse edges"
    print(
        f"filter_view_graph: {np.count_nonzero(labels == 0)} of {edge_count} edges kept,"
        f" {np.count_nonzero(components == 0)} of {image_count} images in the largest component{few}",
        file=sys.stderr,
    )


def refuse_edges(
    image_count: int,
    pairs: np.ndarray,
    rotations: np.ndarray,
    inlier_counts: np.ndarray,
    cycles: Cycles,
    options: "FilterViewGraphOptions",
) -> np.ndarray:
    """What refuses each edge, or ``kept`` (E,) str, as the options say.

    Parameters
    ----------
    pairs, rotations, inlier_counts : (E,2) int images i < j, (E,3,3) j_from_i, (E,) of the edges.
    cycles : of these edges.
    """
    if not _cycles_tell(cycles, options):
        # few cycles mislead; average_rotations judges every edge by its residual
        return np.full(len(pairs), "kept", dtype=object)
    max_error = np.radians(options.max_cycle_error_deg)
    if options.method == "cycles":
        reasons = refuse_by_cycles(len(pairs), cycles, options.first_pass, options.second_pass, max_error)
    else:
        reasons = refuse_by_messages(len(pairs), cycles, inlier_counts, max_error)
    if not options.cluster_vote:
        return reasons
    return vote_between_clusters(
        image_count,
        pairs,
        rotations,
        inlier_counts,
        reasons,
        (reasons == "kept") & np.isfinite(cycles.smallest),
        options.min_cluster_inliers,
        np.radians(options.vote_tolerance_deg),
    )


def _cycles_tell(cycles: Cycles, options: "FilterViewGraphOptions") -> bool:
    """Whether there are enough cycles to refuse edges; the paper's method always does."""
    return options.method == "cycles" or cycles.per_edge >= options.min_cycles_per_edge
