"""Merge the matched positions in the images of one block into keypoints."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import PairCoordinates
from snakesfm.features.extraction import sample_colors
from snakesfm.geometry.detector_pixels import detector_scales, reduce_keypoints
from snakesfm.geometry.detector_sides import USUAL_SIDE_PX
from snakesfm.grouping import join_parts
from snakesfm.ingest.indexed import IndexedImages
from snakesfm.matching.merging import merge_coordinates
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.merge_keypoints import MergeKeypointsOptions

# places and scores
NOTHING = (np.zeros((0, 2), np.float32), np.zeros(0, np.float32))


def run(job: StageJob) -> None:
    """Write the LocalFeatures of the block's images, without descriptors.

    An image's keypoints depend on all pairs that it is in, and neither on their order nor on the blocks.

    Raises
    ------
    SceneError : an image cannot be read now, or is another than when it was indexed.
    """
    options: MergeKeypointsOptions = job.options
    index = ImageIndex.read(job.path("index"))
    rows = np.flatnonzero(index.blocks == int(job.settings["block"]))
    found = _gather(job.paths("matches"), set(rows.tolist()))
    images = IndexedImages(index.names, index.sha256, job.settings["images"])
    progress = job.progress(len(rows), "images")
    parts = []
    scales = detector_scales(index.sizes[rows], job.settings).tolist()
    for row, scale in zip(rows.tolist(), scales, strict=True):
        places, confidences = found[row]
        merged, sure = merge_coordinates(reduce_keypoints(places, scale), confidences, options.radius_px)
        merged = reduce_keypoints(merged, 1.0 / scale)
        parts.append((merged, sure, _read_colors(images, row, merged)))
        progress.step()
    offsets, (keypoints, scores, colors) = join_parts(parts, (*NOTHING, np.zeros((0, 3), np.uint8)))
    count = len(keypoints)
    LocalFeatures(
        image_ids=rows,
        names=index.names[rows],
        sizes=index.sizes[rows],
        digests=np.array([hashlib.sha256(part[0].tobytes()).hexdigest() for part in parts], object),
        offsets=offsets,
        keypoints=keypoints,
        descriptors=np.zeros((count, 0), np.uint8),
        scores=scores,
        scales=np.ones(count, np.float32),
        angles=np.zeros(count, np.float32),
        colors=colors,
    ).write(job.output, job.header)
    before = sum(len(places) for places, _ in found.values())
    print(f"{len(rows)} images, {before} matched positions merged into {count} keypoints")


def _gather(paths: list[Path], images: set[int]) -> Mapping[int, tuple[Array, Array]]:
    """Coordinates (N,2) and scores (N,) of the places of each image, from all pairs that it is in."""
    parts: dict[int, list[tuple[Array, Array]]] = {image: [] for image in images}
    for path in paths:
        tile = PairCoordinates.read(path)
        for row, pair in enumerate(tile.pairs.tolist()):
            part = slice(tile.offsets[row], tile.offsets[row + 1])
            for side, image in enumerate(pair):
                if image in images:
                    places = tile.coordinates[part, 2 * side : 2 * side + 2]
                    parts[image].append((places, tile.scores[part]))
    return {image: tuple(join_parts(some, NOTHING)[1]) for image, some in parts.items()}  # type: ignore[misc]


def _read_colors(images: IndexedImages, row: int, keypoints: Array) -> Array:
    """RGB of an image of the index at the keypoints; black where it cannot be decoded."""
    if len(keypoints) == 0:
        return np.zeros((0, 3), np.uint8)
    # colours need no more pixels
    image = images.read(row, USUAL_SIDE_PX)
    if image is None:
        return np.zeros((len(keypoints), 3), np.uint8)
    return sample_colors(image.rgb, keypoints / image.reduction)
