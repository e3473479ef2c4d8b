"""Average the relative rotations of the view graph to one rotation per image."""

import sys
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.mapping import CameraRotations
from snakesfm.artifacts.pairs import EDGE_LABELS, ViewGraph
from snakesfm.errors import SceneError
from snakesfm.rotation_averaging.base import RotationGraph, edge_residuals
from snakesfm.rotation_averaging.registry import make_averager
from snakesfm.rotation_averaging.verification import average_rotation_components
from snakesfm.stages.job import StageJob

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
    whole = RotationGraph(
        image_count,
        graph.pairs,
        graph.rotations,
        graph.inlier_counts.astype(np.float64),
        graph.covariances[:, :3, :3],
    )
    filtered = reasons == "kept"
    rotations, reasons, components = average_rotation_components(
        make_averager(options.method),
        whole,
        reasons,
        options.min_residual_deg,
        options.max_residual_deg,
        options.min_component_images,
    )
    residuals = np.degrees(edge_residuals(graph.pairs, graph.rotations, rotations))
    CameraRotations(
        rotations=rotations,
        residuals_deg=residuals,
        labels=np.array([EDGE_LABELS.index(reason) for reason in reasons], dtype=np.int8),
        components=components,
    ).write(job.output, job.header)
    kept = reasons == "kept"
    others = np.count_nonzero(components > 0)
    more = f" and {others} in {components.max()} other components" if others else ""
    print(
        f"average_rotations: {np.count_nonzero(components == 0)} of {image_count} images{more},"
        f" {np.count_nonzero(kept)} edges with a median residual of {np.median(residuals[kept]):.2f} deg,"
        f" {np.count_nonzero(kept & ~filtered)} of them refused by filter_view_graph before",
        file=sys.stderr,
    )
