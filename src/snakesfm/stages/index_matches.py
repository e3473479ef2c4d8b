"""Assign the matches of one tile, found without keypoints, to the merged keypoints of its images."""

import hashlib
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.pairs import PairCoordinates, PairMatches
from snakesfm.geometry.detector_pixels import detector_scales, reduce_keypoints
from snakesfm.grouping import join_parts
from snakesfm.matching.merging import MergedKeypoints, index_coordinates
from snakesfm.matching.nearest import no_matches
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.index_matches import IndexMatchesOptions


def run(job: StageJob) -> None:
    """Write the tile's PairMatches."""
    options: IndexMatchesOptions = job.options
    tile = PairCoordinates.read(job.path("matches"))
    merged, digests, scales = _read_features(job)
    parts = []
    for row, (i, j) in enumerate(tile.pairs.tolist()):
        part = slice(tile.offsets[row], tile.offsets[row + 1])
        coordinates = np.hstack(
            [
                reduce_keypoints(tile.coordinates[part, :2], scales[i]),
                reduce_keypoints(tile.coordinates[part, 2:], scales[j]),
            ]
        )
        confidences = tile.scores[part]
        parts.append(
            index_coordinates(coordinates, confidences, merged[i], merged[j], options.max_distance_px)
        )
    offsets, (matches, scores) = join_parts(parts, no_matches())
    PairMatches(
        pairs=tile.pairs,
        digests=np.array(
            [
                hashlib.sha256("\0".join((str(digest), digests[i], digests[j])).encode()).hexdigest()
                for digest, (i, j) in zip(tile.digests, tile.pairs.tolist(), strict=True)
            ],
            object,
        ),
        offsets=offsets,
        matches=matches,
        scores=scores,
    ).write(job.output, job.header)
    print(
        f"{len(tile.pairs)} pairs, {len(tile.scores)} matches found, "
        f"{len(matches)} of them between different keypoints"
    )


def _read_features(job: StageJob) -> tuple[dict[int, MergedKeypoints], dict[int, str], dict[int, float]]:
    """Keypoints in detector pixels, digests and scales of the tile's images."""
    merged, digests, scales = {}, {}, {}
    for path in job.paths("features"):
        block = LocalFeatures.read(path)
        widths = detector_scales(block.sizes, job.settings).tolist()
        for row, image in enumerate(block.image_ids.tolist()):
            keypoints = block.keypoints[block.offsets[row] : block.offsets[row + 1]]
            merged[image] = MergedKeypoints(reduce_keypoints(keypoints, widths[row]))
            digests[image] = str(block.digests[row])
            scales[image] = widths[row]
    return merged, digests, scales
