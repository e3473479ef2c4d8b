"""Refuse edges of the view graph that contradict the others."""

import dataclasses
import sys
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import EDGE_LABELS, ViewGraph
from snakesfm.stages.job import StageJob
from snakesfm.view_graph.components import label_components
from snakesfm.view_graph.cycles import find_cycles, median_of
from snakesfm.view_graph.filters import refuse_by_cycles, refuse_by_messages, vote_between_clusters

if TYPE_CHECKING:
    from snakesfm.config.filter_view_graph import FilterViewGraphOptions


def run(job: StageJob) -> None:
    """Read the view graph, write it with the edges' labels, cycle errors and components."""
    options: FilterViewGraphOptions = job.options
    with ImageIndex.open(job.path("index")) as file:
        image_count = len(file["names"])
    graph = ViewGraph.read(job.path("graph"))
    edge_count = len(graph.pairs)
    max_error = np.radians(options.max_cycle_error_deg)
    cycles = find_cycles(image_count, graph.pairs, graph.rotations)
    telling = options.method == "cycles" or cycles.per_edge >= options.min_cycles_per_edge
    if options.method == "cycles":
        reasons = refuse_by_cycles(edge_count, cycles, options.first_pass, options.second_pass, max_error)
    elif telling:
        reasons = refuse_by_messages(edge_count, cycles, graph.inlier_counts, max_error)
    else:
        # few cycles mislead; average_rotations judges every edge by its residual
        reasons = np.full(edge_count, "kept", dtype=object)
    if options.cluster_vote and telling:
        reasons = vote_between_clusters(
            image_count,
            graph.pairs,
            graph.rotations,
            graph.inlier_counts,
            reasons,
            (reasons == "kept") & np.isfinite(cycles.smallest),
            options.min_cluster_inliers,
            np.radians(options.vote_tolerance_deg),
        )
    components = label_components(image_count, graph.pairs[reasons == "kept"])
    labels = np.array([EDGE_LABELS.index(reason) for reason in reasons], dtype=np.int8)
    dataclasses.replace(
        graph,
        labels=labels,
        cycle_min_deg=np.degrees(cycles.smallest),
        cycle_median_deg=np.degrees(median_of(edge_count, cycles, np.ones(edge_count, dtype=bool))),
        components=components,
    ).write(job.output, job.header)
    sparse = "" if telling else f"; {cycles.per_edge:.1f} 3-cycles per edge are too few to refuse any"
    print(
        f"filter_view_graph: {np.count_nonzero(labels == 0)} of {edge_count} edges kept,"
        f" {np.count_nonzero(components == 0)} of {image_count} images in the largest component{sparse}",
        file=sys.stderr,
    )
