"""Merge the accepted two-view geometries of all tiles into one view graph."""

import sys

import numpy as np

from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import TwoViewGeometries, ViewGraph
from snakesfm.errors import SceneError
from snakesfm.stages.job import StageJob
from snakesfm.view_graph.components import label_components

EDGE_COLUMNS = (
    "pairs",
    "rotations",
    "translations",
    "covariances",
    "kinds",
    "inlier_counts",
    "triangulation_angles_deg",
)


def run(job: StageJob) -> None:
    """Read the image index and the two-view geometries of all tiles, write the view graph.

    Raises
    ------
    SceneError : no pair of images was accepted.
    """
    with ImageIndex.open(job.path("index")) as file:
        image_count = len(file["names"])
    columns: dict[str, list[np.ndarray]] = {name: [] for name in EDGE_COLUMNS}
    refused = 0
    for path in job.paths("geometries"):
        # the inlier matches are most of the file and not needed here
        with TwoViewGeometries.open(path) as file:
            accepted = file["rejections"][()] == 0
            refused += int(np.count_nonzero(~accepted))
            for name in EDGE_COLUMNS:
                columns[name].append(file[name][()][accepted])
    merged = {name: np.concatenate(parts) for name, parts in columns.items() if parts}
    edge_count = len(merged["pairs"]) if merged else 0
    if edge_count == 0:
        raise SceneError(
            f"No two images of scene '{job.scene}' overlap well enough ({refused} pairs were tried): add"
            " images of the same objects from nearby positions, or lower the inlier limits of"
            " estimate_two_view."
        )
    order = np.lexsort((merged["pairs"][:, 1], merged["pairs"][:, 0]))
    merged = {name: values[order] for name, values in merged.items()}
    components = label_components(image_count, merged["pairs"])
    unknown = np.full(edge_count, np.nan)
    ViewGraph(
        **merged,
        labels=np.zeros(edge_count, dtype=np.int8),
        cycle_min_deg=unknown,
        cycle_median_deg=unknown,
        components=components,
    ).write(job.output, job.header)
    connected = int(np.count_nonzero(components == 0))
    print(
        f"build_view_graph: {edge_count} pairs accepted, {refused} rejected;"
        f" the largest component has {connected} of {image_count} images",
        file=sys.stderr,
    )
