"""Match the pairs of one tile: their keypoints, or without keypoints the images themselves."""

import functools
import math
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.hloc import open_hloc, read_hloc_matches
from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import ImagePairs, PairCoordinates, PairMatches
from snakesfm.digests import result_digest
from snakesfm.features.keypoints import KeypointSet
from snakesfm.front_ends import DETECTOR_FREE
from snakesfm.geometry.detector_sides import LEAST_SIDE_PX
from snakesfm.grouping import join_parts
from snakesfm.hloc_files import MATCHES
from snakesfm.learned.batches import cut
from snakesfm.matching.detector_free import (
    DETECTOR_FREE_MATCHERS,
    STRIP_IMAGES,
    DetectorFreeMatcher,
    Picture,
    no_coordinates,
)
from snakesfm.matching.matcher import MATCHERS, BatchMatcher, Matcher
from snakesfm.matching.nearest import no_matches
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.match_pairs import MatchPairsOptions

Matches = tuple[Array, Array]


REUSES_FORMER = True
COLUMNS = ("keypoints", "descriptors", "scores", "scales", "angles")
# second images: descriptors of 5,000 keypoints take 160 MB, pictures of 840 x 632 pixels 140 MB
HELD_IMAGES = 256


def run(job: StageJob) -> None:
    """Match pair after pair, taking over pairs whose images and options are unchanged.

    Writes PairMatches, or PairCoordinates where there are no keypoints. The features (or the pictures) of
    ``HELD_IMAGES`` images and of a network's batch are held at a time, whatever the size of the blocks.

    Raises
    ------
    SceneError : an image cannot be read now, or is another than when it was indexed.
    """
    options: MatchPairsOptions = job.options
    pairs = ImagePairs.read(job.path("pairs")).pairs
    free = options.method in DETECTOR_FREE
    kind: type[PairMatches | PairCoordinates] = PairCoordinates if free else PairMatches
    matcher: Any = _create_detector_free(job, options) if free else _create_matcher(job, options)
    beside = job.sources_digest()
    if options.method == "virtual_places":
        beside += f" {job.seed}"
    with ExitStack() as stack:
        source = ImageFiles(job) if free else FeatureFiles(job, stack)
        digests = [
            result_digest(options, beside, source.digests[i], source.digests[j]) for i, j in pairs.tolist()
        ]
        results = job.take_over(digests, functools.partial(_read_former, kind))
        reused = len(results)
        progress = job.progress(len(pairs) - reused, "pairs")
        # all second images pass by so many first ones, of which each is prepared once
        width = STRIP_IMAGES if free else 1
        read_first = functools.lru_cache(width)(lambda i: matcher.prepare(source.read(i)))
        read_second = functools.lru_cache(HELD_IMAGES)(lambda j: matcher.prepare_second(source.read(j)))
        strips = np.unique(pairs[:, 0], return_inverse=True)[1] // width
        missing = [row for row in np.lexsort((*pairs.T, strips)).tolist() if row not in results]
        for rows in cut(missing, job.network_batch()):
            prepared = [(read_first(i), read_second(j)) for i, j in pairs[rows].tolist()]
            results |= zip(rows, _match(matcher, prepared), strict=True)
            progress.step(len(rows))
    if isinstance(source, ImageFiles) and source.images.damaged:
        damaged = list(source.images.damaged.values())
        job.warn(f"{len(damaged)} images cannot be read and so match no other: {damaged[0]}")
    matches = [results[row] for row in range(len(pairs))]
    _collect(kind, pairs, digests, matches).write(job.output, job.header)
    counts = [len(rows) for rows, _ in matches]
    print(
        f"{len(pairs)} pairs ({reused} taken over), {sum(counts)} matches, "
        f"median {int(np.median(counts)) if counts else 0} per pair, {counts.count(0)} pairs without any"
    )


def _match(matcher: Any, prepared: list[tuple[Any, Any]]) -> list[Matches]:
    """The matches of pairs of prepared images, together where the matcher can."""
    if isinstance(matcher, BatchMatcher):
        return matcher.match_batch(prepared)
    return [matcher.match(first, second) for first, second in prepared]


def _create_matcher(job: StageJob, options: "MatchPairsOptions") -> Matcher:
    if options.method == "imported":
        return ImportedMatches(Path(job.settings["imported"]) / MATCHES)
    if options.method == "virtual":
        return MATCHERS["virtual"]()
    if options.method == "mutual_ratio":
        names = {"max_ratio", "words", "probes"}
        return MATCHERS["mutual_ratio"](**options.model_dump(include=names))
    detector = str(job.settings.get("detector", "sift"))
    return MATCHERS[options.method](
        detector=detector,
        min_score=float(options.min_score),
        state=job.read_weights(f"{detector}_{options.method}"),
    )


def _create_detector_free(job: StageJob, options: "MatchPairsOptions") -> DetectorFreeMatcher:
    if options.method == "virtual_places":
        from snakesfm.evaluation.colmap_model import read_model

        return DETECTOR_FREE_MATCHERS[options.method](
            model=read_model(Path(job.settings["reference"])),
            spread_px=options.spread_px,
            noise_px=options.noise_px,
            seed=job.seed,
        )
    return DETECTOR_FREE_MATCHERS[options.method](
        min_score=float(options.min_score),
        longer_side_px=options.longer_side_px,
        state=job.read_weights(options.method),
    )


class ImportedMatches:
    """The matches of a file that hloc wrote, as a matcher; a pair that it lacks has none.

    They are one to one, with scores in 0 .. 1, where those of the file are.

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


class FeatureFiles:
    """The open feature files of a tile, from which single images are read.

    Parameters
    ----------
    job : with the files, and the index where a network matches keypoints: it knows images as shown.
    stack : closes the files.
    """

    def __init__(self, job: StageJob, stack: ExitStack) -> None:
        self.digests: dict[int, str] = {}
        self._places: dict[int, tuple[list[Any], slice, tuple[int, int], str]] = {}
        index = [ImageIndex.read(path) for path in job.paths("index")]
        self._orientations = index[0].orientations.tolist() if index else None
        for path in job.paths("features"):
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
        points = replace(points, image_size=size, image_name=name)
        return points if self._orientations is None else points.shown(self._orientations[image])


class ImageFiles:
    """The images of a scene, read one by one; one that cannot be decoded is black.

    Parameters
    ----------
    job : with the index, the image folder and the size that is wanted.
    """

    def __init__(self, job: StageJob) -> None:
        from snakesfm.ingest.indexed import IndexedImages

        index = ImageIndex.read(job.paths("index")[0])
        self.images = IndexedImages(index.names, index.sha256, job.settings["images"])
        self._names = [str(name) for name in index.names]
        self.digests = [str(digest) for digest in index.sha256]
        if job.options.method == "virtual_places":
            # the oracle knows an image by its name
            self.digests = [" ".join(both) for both in zip(self.digests, self._names, strict=True)]
        self._sizes = [(width, height) for width, height in index.sizes.tolist()]
        self._orientations = index.orientations.tolist()
        self._side_px = int(job.options.longer_side_px)

    def read(self, image: int) -> Picture:
        """One image of the index, not smaller than the matcher wants it."""
        name, size, orientation = self._names[image], self._sizes[image], self._orientations[image]
        shorter = max(math.ceil(self._side_px * min(size) / max(size)), LEAST_SIDE_PX)
        pixels = self.images.read(image, shorter)
        if pixels is None:
            black = np.zeros((size[1], size[0], 3), np.uint8)
            return Picture(name, size, black[..., 0], black)
        # the last column and row may go beyond the original image
        width, height = (max(1, side // pixels.reduction) for side in size)
        gray, rgb = pixels.gray[:height, :width], pixels.rgb[:height, :width]
        return Picture(name, size, gray, rgb, pixels.reduction, orientation)


def _read_former(
    kind: type[PairMatches | PairCoordinates], path: Path, wanted: set[str]
) -> Mapping[str, Matches]:
    """What an earlier file holds of the pairs that are unchanged, by digest."""
    former = kind.read_former(path)
    if former is None:
        return {}
    found = former.coordinates if isinstance(former, PairCoordinates) else former.matches
    parts = [slice(*former.offsets[row : row + 2]) for row in range(len(former.pairs))]
    return {
        str(digest): (found[part], former.scores[part])
        for digest, part in zip(former.digests, parts, strict=True)
        if digest in wanted
    }


def _collect(
    kind: type[PairMatches | PairCoordinates], pairs: Array, digests: list[str], results: list[Matches]
) -> PairMatches | PairCoordinates:
    free = kind is PairCoordinates
    offsets, (matches, scores) = join_parts(results, no_coordinates() if free else no_matches())
    return kind(
        pairs=pairs,
        digests=np.array(digests, dtype=object),
        offsets=offsets,
        **{"coordinates" if free else "matches": matches},
        scores=scores,
    )
