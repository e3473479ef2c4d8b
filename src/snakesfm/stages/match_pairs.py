"""Match the keypoints of the pairs of one tile."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.pairs import ImagePairs, PairMatches
from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.matcher import create_matcher
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.match_pairs import MatchPairsOptions

Array = NDArray[Any]
Matches = tuple[Array, Array]


REUSES_FORMER = True


def run(job: StageJob) -> None:
    """Match pair after pair, taking over pairs whose images and options are unchanged; write PairMatches.

    Two images' features are held at a time, whatever the size of the blocks.
    """
    options: MatchPairsOptions = job.options
    pairs = ImagePairs.read(job.path("pairs")).pairs
    matcher = create_matcher(**options.model_dump())
    with ExitStack() as stack:
        features = FeatureFiles(job.paths("features"), stack)
        digests = [_digest(features.digests[i], features.digests[j], options) for i, j in pairs.tolist()]
        former = _read_former(job.former, set(digests))
        progress = job.progress(len(pairs), "pairs")
        results: list[Matches] = []
        held, first = -1, None
        for (i, j), digest in zip(pairs.tolist(), digests, strict=True):
            result = former.get(digest)
            if result is None:
                if first is None or i != held:
                    held, first = i, matcher.prepare(features.read(i))
                result = matcher.match(first, features.read(j))
            results.append(result)
            progress.step()
    _collect(pairs, digests, results).write(job.output, job.header)
    counts = [len(matches) for matches, _ in results]
    reused = sum(digest in former for digest in digests)
    print(
        f"{len(pairs)} pairs ({reused} taken over), {sum(counts)} matches, "
        f"median {int(np.median(counts)) if counts else 0} per pair"
    )


class FeatureFiles:
    """The open feature files of a tile, from which single images are read.

    Parameters
    ----------
    paths : files of LocalFeatures.
    stack : closes the files.
    """

    def __init__(self, paths: Sequence[Path], stack: ExitStack) -> None:
        self.digests: dict[int, str] = {}
        self._places: dict[int, tuple[Any, slice]] = {}
        for path in paths:
            file = stack.enter_context(LocalFeatures.open(path))
            offsets = file["offsets"][()].tolist()
            digests = file["digests"].asstr()[()]
            for row, image in enumerate(file["image_ids"][()].tolist()):
                self.digests[image] = str(digests[row])
                self._places[image] = (file, slice(offsets[row], offsets[row + 1]))

    def read(self, image: int) -> KeypointSet:
        """The features of one image of the index."""
        file, part = self._places[image]
        columns = ("keypoints", "descriptors", "scores", "scales", "angles")
        return KeypointSet(*(file[column][part] for column in columns))


def _digest(first: str, second: str, options: "MatchPairsOptions") -> str:
    text = "\0".join((first, second, options.canonical_json(), str(options.stage_version)))
    return hashlib.sha256(text.encode()).hexdigest()


def _read_former(path: Path | None, wanted: set[str]) -> Mapping[str, Matches]:
    """What an earlier file holds of the pairs that are unchanged, by digest."""
    former = PairMatches.read_former(path)
    if former is None:
        return {}
    parts = [slice(*former.offsets[row : row + 2]) for row in range(len(former.pairs))]
    return {
        str(digest): (former.matches[part], former.scores[part])
        for digest, part in zip(former.digests, parts, strict=True)
        if digest in wanted
    }


def _collect(pairs: Array, digests: list[str], results: list[Matches]) -> PairMatches:
    # an empty pair in front keeps shapes and dtypes where the tile has no pair
    matches = [np.zeros((0, 2), np.int32), *(matches for matches, _ in results)]
    scores = [np.zeros(0, np.float32), *(scores for _, scores in results)]
    return PairMatches(
        pairs=pairs,
        digests=np.array(digests, dtype=object),
        offsets=np.cumsum([len(part) for part in matches]),
        matches=np.concatenate(matches),
        scores=np.concatenate(scores),
    )
