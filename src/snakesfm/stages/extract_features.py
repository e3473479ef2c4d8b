"""Find and describe keypoints in the images of one block."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.hloc import FEATURES, descriptor_size, open_hloc, read_hloc_features
from snakesfm.artifacts.images import ImageIndex
from snakesfm.errors import ImageError
from snakesfm.features.extraction import create_detector, extract_keypoints, sample_colors
from snakesfm.features.keypoints import Detector, KeypointSet, KeypointSource
from snakesfm.ingest.read import read_image
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.extract_features import ExtractFeaturesOptions

Array = NDArray[Any]


@dataclass(frozen=True)
class ColoredKeypoints:
    """Keypoints of one image and the image's colour (N,3) uint8 at each."""

    points: KeypointSet
    colors: Array


REUSES_FORMER = True


def run(job: StageJob) -> None:
    """Read the block's images one by one and write their LocalFeatures.

    An image that cannot be decoded gets no keypoints and a warning; the others go on.
    """
    cv2.setNumThreads(job.threads)
    options: ExtractFeaturesOptions = job.options
    index = ImageIndex.read(job.path("index"))
    rows = np.flatnonzero(index.blocks == int(job.settings["block"]))
    folder = Path(job.settings["images"])
    finder = _create_finder(job, options)
    beside = job.weights_digest() + str(job.settings.get("source_content", ""))
    digests = [_digest(str(index.sha256[row]), options, beside) for row in rows]
    former = job.take_over(digests, _read_former)
    progress = job.progress(len(rows), "images")
    results = []
    for row, digest in zip(rows, digests, strict=True):
        result = former.get(digest)
        if result is None:
            result = _extract(
                folder, str(index.names[row]), tuple(index.sizes[row].tolist()), finder, options
            )
        results.append(result)
        progress.step()
    _collect(index, rows, digests, results, finder).write(job.output, job.header)
    counts = [len(result.points) for result in results]
    reused = sum(digest in former for digest in digests)
    print(
        f"{len(rows)} images ({reused} taken over), {sum(counts)} keypoints, "
        f"median {int(np.median(counts)) if counts else 0} per image"
    )


def _create_finder(job: StageJob, options: "ExtractFeaturesOptions") -> Detector | KeypointSource:
    """What finds the keypoints in an image, or knows them by its name."""
    if options.method == "virtual":
        from snakesfm.evaluation.colmap_model import read_model
        from snakesfm.features.virtual import VirtualKeypoints

        model = read_model(Path(job.settings["reference"]))
        return VirtualKeypoints(model, options.surface_points)
    if options.method == "imported":
        return ImportedKeypoints(Path(job.settings["imported"]) / FEATURES)
    if options.method == "sift":
        return create_detector(
            "sift",
            contrast_threshold=options.contrast_threshold,
            edge_threshold=options.edge_threshold,
            upright=options.upright,
        )
    return create_detector(options.method, state=job.read_weights(options.method))


class ImportedKeypoints:
    """The keypoints of a file that hloc wrote, all of them; an image that it lacks has none.

    Parameters
    ----------
    path : hloc's file of features.
    """

    descriptor_dtype: Any = np.float16
    usual_keypoints = 0

    def __init__(self, path: Path) -> None:
        self._file = open_hloc(path)
        self.descriptor_size = descriptor_size(self._file)

    def read(self, name: str, size: tuple[int, int]) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.KeypointSource`."""
        columns = read_hloc_features(self._file, name)
        if columns is None:
            print(f"warning: {self._file.filename} has no keypoints of '{name}'")
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        return KeypointSet(
            columns["keypoints"],
            columns["descriptors"],
            columns["scores"],
            columns["scales"],
            columns["angles"],
            size,
        )


def _digest(sha256: str, options: "ExtractFeaturesOptions", beside: str) -> str:
    text = "\0".join((sha256, options.canonical_json(), str(options.stage_version), beside))
    return hashlib.sha256(text.encode()).hexdigest()


def _extract(
    folder: Path,
    name: str,
    size: tuple[int, int],
    finder: Detector | KeypointSource,
    options: "ExtractFeaturesOptions",
) -> ColoredKeypoints:
    try:
        image = read_image(folder / name, options.max_shorter_side_px)
    except ImageError as error:
        print(f"warning: {error}")
        nothing = KeypointSet.empty(finder.descriptor_size, finder.descriptor_dtype)
        return ColoredKeypoints(nothing, np.zeros((0, 3), np.uint8))
    most = finder.usual_keypoints if options.max_keypoints == "auto" else options.max_keypoints
    if isinstance(finder, KeypointSource):
        points = finder.read(name, size)
        if options.method == "virtual":
            points = points.take(np.argsort(-points.scores, kind="stable")[:most])
        return ColoredKeypoints(points, sample_colors(image.rgb, points.keypoints / image.reduction))
    points = extract_keypoints(finder, image.gray, image.rgb, most, options.max_shorter_side_px)
    colors = sample_colors(image.rgb, points.keypoints)
    return ColoredKeypoints(points.scaled(image.reduction, image.reduction), colors)


def _read_former(path: Path, wanted: set[str]) -> Mapping[str, ColoredKeypoints]:
    """What an earlier file holds of the images that are unchanged, by digest."""
    former = LocalFeatures.read_former(path)
    if former is None:
        return {}
    taken = {}
    for row, digest in enumerate(former.digests):
        if digest in wanted:
            part = slice(former.offsets[row], former.offsets[row + 1])
            points = KeypointSet(
                former.keypoints[part],
                former.descriptors[part],
                former.scores[part],
                former.scales[part],
                former.angles[part],
            )
            taken[str(digest)] = ColoredKeypoints(points, former.colors[part])
    return taken


def _collect(
    index: ImageIndex,
    rows: Array,
    digests: list[str],
    results: list[ColoredKeypoints],
    finder: Detector | KeypointSource,
) -> LocalFeatures:
    # an empty set in front keeps shapes and dtypes where the block has no image
    points = [KeypointSet.empty(finder.descriptor_size, finder.descriptor_dtype)]
    points += [result.points for result in results]
    colors = [np.zeros((0, 3), np.uint8), *(result.colors for result in results)]
    return LocalFeatures(
        image_ids=rows,
        names=index.names[rows],
        sizes=index.sizes[rows],
        digests=np.array(digests, dtype=object),
        offsets=np.cumsum([len(part) for part in points]),
        keypoints=np.concatenate([part.keypoints for part in points]),
        descriptors=np.concatenate([part.descriptors for part in points]),
        scores=np.concatenate([part.scores for part in points]),
        scales=np.concatenate([part.scales for part in points]),
        angles=np.concatenate([part.angles for part in points]),
        colors=np.concatenate(colors),
    )
