"""Match the keypoints of the pairs of one tile."""

import functools
import hashlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.hloc import MATCHES, open_hloc, read_hloc_matches
from snakesfm.artifacts.pairs import ImagePairs, PairMatches
from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.matcher import Matcher, create_matcher
from snakesfm.matching.nearest import no_matches
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.match_pairs import MatchPairsOptions

Array = NDArray[Any]
Matches = tuple[Array, Array]


REUSES_FORMER = True
COLUMNS = ("keypoints", "descriptors", "scores", "scales", "angles")
# descriptors of so many images take 20 MB at 5,000 keypoints
HELD_IMAGES = 32


def run(job: StageJob) -> None:
    """Match pair after pair, taking over pairs whose images and options are unchanged; write PairMatches.

    The features of ``HELD_IMAGES`` images are held at a time, whatever the size of the blocks.
    """
    options: MatchPairsOptions = job.options
    pairs = ImagePairs.read(job.path("pairs")).pairs
    matcher = _create_matcher(job, options)
    beside = job.weights_digest() + str(job.settings.get("source_content", ""))
    with ExitStack() as stack:
        features = FeatureFiles(job.paths("features"), stack)
        digests = [
            _digest(features.digests[i], features.digests[j], options, beside) for i, j in pairs.tolist()
        ]
        former = job.take_over(digests, _read_former)
        results = {row: former[digest] for row, digest in enumerate(digests) if digest in former}
        reused = len(results)
        progress = job.progress(len(pairs) - reused, "pairs")
        read_second = functools.lru_cache(HELD_IMAGES)(lambda j: matcher.prepare_second(features.read(j)))
        held, first = -1, None
        for row in _order(pairs, np.array([row for row in range(len(pairs)) if row not in results], int)):
            i, j = pairs[row].tolist()
            if i != held:
                held, first = i, matcher.prepare(features.read(i))
            results[row] = matcher.match(first, read_second(j))
            progress.step()
    matches = [results[row] for row in range(len(pairs))]
    _collect(pairs, digests, matches).write(job.output, job.header)
    counts = [len(rows) for rows, _ in matches]
    print(
        f"{len(pairs)} pairs ({reused} taken over), {sum(counts)} matches, "
        f"median {int(np.median(counts)) if counts else 0} per pair, {counts.count(0)} pairs without any"
    )


def _create_matcher(job: StageJob, options: "MatchPairsOptions") -> Matcher:
    if options.method == "imported":
        return ImportedMatches(Path(job.settings["imported"]) / MATCHES)
    if options.method == "virtual":
        return create_matcher("virtual")
    detector = str(job.settings.get("detector", "sift"))
    if options.method == "mutual_ratio":
        names = {"max_ratio", "search", "words", "probes", "preview_keypoints", "min_likeness"}
        chosen = options.model_dump(include=names)
        # other keypoints have no scales, and what their descriptors resemble was never measured
        previewed = {} if detector == "sift" else {"preview_keypoints": 0}
        return create_matcher("mutual_ratio", **chosen | previewed)
    return create_matcher(
        options.method,
        detector=detector,
        min_score=options.min_score,
        state=job.read_weights(f"{detector}_{options.method}"),
    )


class ImportedMatches:
    """The matches of a file that hloc wrote, as a matcher; a pair that it lacks has none.

    Parameters
    ----------
    path : hloc's file of matches.
    """

    def __init__(self, path: Path) -> None:
        self._file = open_hloc(path)

    def prepare(self, first: KeypointSet) -> tuple[str, int]:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        return first.image_name, len(first)

    prepare_second = prepare

    def match(self, first: tuple[str, int], second: tuple[str, int]) -> Matches:
        """See :class:`snakesfm.matching.matcher.Matcher`."""
        names, counts = (first[0], second[0]), (first[1], second[1])
        return read_hloc_matches(self._file, names, counts) or no_matches()


def _order(pairs: Array, rows: Array) -> list[int]:
    """The rows in an order in which ``HELD_IMAGES`` second images meet all their first ones."""
    group = np.unique(pairs[rows, 1], return_inverse=True)[1] // HELD_IMAGES
    ordered: list[int] = rows[np.lexsort((pairs[rows, 1], pairs[rows, 0], group))].tolist()
    return ordered


class FeatureFiles:
    """The open feature files of a tile, from which single images are read.

    Parameters
    ----------
    paths : files of LocalFeatures.
    stack : closes the files.
    """

    def __init__(self, paths: Sequence[Path], stack: ExitStack) -> None:
        self.digests: dict[int, str] = {}
        self._places: dict[int, tuple[list[Any], slice, tuple[int, int], str]] = {}
        for path in paths:
            file = stack.enter_context(LocalFeatures.open(path))
            offsets = file["offsets"][()].tolist()
            digests, names = file["digests"].asstr()[()], file["names"].asstr()[()]
            sizes = [(width, height) for width, height in file["sizes"][()].tolist()]
            # finding a column by its name takes longer than reading an image's part of it
            columns = [file[column] for column in COLUMNS]
            for row, image in enumerate(file["image_ids"][()].tolist()):
                self.digests[image] = str(digests[row])
                part = slice(offsets[row], offsets[row + 1])
                self._places[image] = (columns, part, sizes[row], str(names[row]))

    def read(self, image: int) -> KeypointSet:
        """The features of one image of the index."""
        columns, part, size, name = self._places[image]
        points = KeypointSet(*(column[part] for column in columns))
        return replace(points, image_size=size, image_name=name)


def _digest(first: str, second: str, options: "MatchPairsOptions", beside: str) -> str:
    text = "\0".join((first, second, options.canonical_json(), str(options.stage_version), beside))
    return hashlib.sha256(text.encode()).hexdigest()


def _read_former(path: Path, wanted: set[str]) -> Mapping[str, Matches]:
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
