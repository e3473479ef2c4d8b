"""Express the matches of one tile, found without keypoints, in the merged keypoints of its images."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.pairs import PairCoordinates, PairMatches
from snakesfm.matching.merging import MergedKeypoints, index_coordinates
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.index_matches import IndexMatchesOptions


def run(job: StageJob) -> None:
    """Write the tile's PairMatches."""
    options: IndexMatchesOptions = job.options
    tile = PairCoordinates.read(job.path("matches"))
    merged, digests = _read_features(job.paths("features"))
    # an empty pair in front keeps shapes and dtypes where the tile has no pair
    matches, scores = [np.zeros((0, 2), np.int32)], [np.zeros(0, np.float32)]
    for row, (i, j) in enumerate(tile.pairs.tolist()):
        part = slice(tile.offsets[row], tile.offsets[row + 1])
        found, sure = index_coordinates(
            tile.coordinates[part], tile.scores[part], merged[i], merged[j], options.max_distance_px
        )
        matches.append(found)
        scores.append(sure)
    PairMatches(
        pairs=tile.pairs,
        digests=np.array(
            [
                hashlib.sha256("\0".join((str(digest), digests[i], digests[j])).encode()).hexdigest()
                for digest, (i, j) in zip(tile.digests, tile.pairs.tolist(), strict=True)
            ],
            object,
        ),
        offsets=np.cumsum([len(part) for part in matches]),
        matches=np.concatenate(matches),
        scores=np.concatenate(scores),
    ).write(job.output, job.header)
    print(
        f"{len(tile.pairs)} pairs, {len(tile.scores)} matches found, "
        f"{sum(map(len, matches))} of them between different keypoints"
    )


def _read_features(paths: list[Path]) -> tuple[dict[int, MergedKeypoints], dict[int, str]]:
    """Keypoints and digests of the tile's images."""
    merged, digests = {}, {}
    for path in paths:
        block = LocalFeatures.read(path)
        for row, image in enumerate(block.image_ids.tolist()):
            merged[image] = MergedKeypoints(block.keypoints[block.offsets[row] : block.offsets[row + 1]])
            digests[image] = str(block.digests[row])
    return merged, digests
