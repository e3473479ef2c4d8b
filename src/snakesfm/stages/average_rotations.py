"""Average the relative rotations of the kept edges to one rotation per image."""

import sys
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.mapping import CameraRotations
from snakesfm.artifacts.pairs import EDGE_LABELS, ViewGraph
from snakesfm.errors import SceneError
from snakesfm.rotation_averaging.base import edge_residuals
from snakesfm.rotation_averaging.registry import make_averager
from snakesfm.rotation_averaging.rejection import residual_limit
from snakesfm.stages.job import StageJob
from snakesfm.view_graph.filters import keep_largest_component

if TYPE_CHECKING:
    from snakesfm.config.average_rotations import AverageRotationsOptions


def run(job: StageJob) -> None:
    """Read the filtered view graph, write rotations, residuals and the edges' new labels.

    Raises
    ------
    SceneError : the filters kept no edge.
    """
    options: AverageRotationsOptions = job.options
    with ImageIndex.open(job.path("index")) as file:
        image_count = len(file["names"])
    graph = ViewGraph.read(job.path("graph"))
    reasons = np.array([EDGE_LABELS[label] for label in graph.labels], dtype=object)
    if not (reasons == "kept").any():
        raise SceneError(
            f"The filters kept no edge of the view graph of scene '{job.scene}':"
            " raise max_cycle_error_deg of filter_view_graph or add images."
        )
    averager = make_averager(options.method)
    components = graph.components
    for _ in range(options.passes):
        kept = reasons == "kept"
        rotations = averager.average(
            image_count,
            graph.pairs[kept],
            graph.rotations[kept],
            graph.inlier_counts[kept],
            graph.covariances[kept, :3, :3],
            job.seed_for(),
        )
        residuals = np.degrees(edge_residuals(graph.pairs, graph.rotations, rotations))
        limit = residual_limit(residuals[kept], options.min_residual_deg, options.max_residual_deg)
        refused = kept & (residuals > limit)
        if np.array_equal(refused, kept):
            # nothing agrees with anything: better some rotations, labelled by their residuals, than none
            break
        reasons[refused] = "rotation_residual"
        reasons, components = keep_largest_component(image_count, graph.pairs, reasons)
        if (reasons[kept] == "kept").all():
            break
    rotations[components != 0] = np.nan
    first = np.flatnonzero(components == 0)[0]
    rotations = rotations @ rotations[first].T
    outside = (components[graph.pairs] != 0).any(axis=1)
    CameraRotations(
        rotations=rotations,
        residuals_deg=np.where(outside, np.nan, residuals),
        labels=np.array([EDGE_LABELS.index(reason) for reason in reasons], dtype=np.int8),
    ).write(job.output, job.header)
    kept = reasons == "kept"
    print(
        f"average_rotations: {np.count_nonzero(components == 0)} of {image_count} images,"
        f" {np.count_nonzero(kept)} edges with a median residual of {np.median(residuals[kept]):.2f} deg",
        file=sys.stderr,
    )
