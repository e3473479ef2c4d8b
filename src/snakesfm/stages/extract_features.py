"""Find and describe keypoints in the images of one block."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.hloc import (
    descriptor_size,
    open_hloc,
    read_hloc_features,
    read_hloc_size,
)
from snakesfm.artifacts.images import ImageIndex
from snakesfm.digests import file_digest, result_digest
from snakesfm.errors import ConfigError
from snakesfm.features.extraction import DETECTORS, extract_keypoints, sample_colors
from snakesfm.features.keypoints import Detector, KeypointSet, KeypointSource
from snakesfm.front_ends import LEARNED_DETECTORS
from snakesfm.geometry.orientations import show_pixels
from snakesfm.grouping import join_parts
from snakesfm.hloc_files import FEATURES
from snakesfm.ingest.discover import MASK_DIGESTS_NAME, fingerprint_images
from snakesfm.ingest.indexed import IndexedImages
from snakesfm.ingest.masks import find_mask, read_mask
from snakesfm.ingest.read import ImagePixels
from snakesfm.learned.batches import in_batches
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.extract_features import ExtractFeaturesOptions


@dataclass(frozen=True)
class ColoredKeypoints:
    """Keypoints of one image and the image's colour (N,3) uint8 at each."""

    points: KeypointSet
    colors: Array


REUSES_FORMER = True
COLUMNS = ("keypoints", "descriptors", "scores", "scales", "angles")
# the sides of a scaled image are whole pixels
ASPECT_TOLERANCE = 0.01


def run(job: StageJob) -> None:
    """Read the block's images, as many at a time as a network gets at once, and write their LocalFeatures.

    An image that cannot be decoded gets no keypoints and a warning; the others go on.

    Raises
    ------
    SceneError : an image cannot be read now, or is another than when it was indexed.
    ConfigError : a mask cannot be read, or does not show the whole of its image; hloc's file does not fit.
    """
    cv2.setNumThreads(job.threads)
    options: ExtractFeaturesOptions = job.options
    index = ImageIndex.read(job.path("index"))
    rows = np.flatnonzero(index.blocks == int(job.settings["block"]))
    pictures = IndexedImages(index.names, index.sha256, job.settings["images"])
    finder = _create_finder(job, options)
    beside = job.sources_digest()
    names = [str(name) for name in index.names[rows]]
    # before they are read, so that a mask that changes meanwhile is noticed
    told = _told_of_masks(job)
    masks = _find_masks(job, names)
    contents = {name: file_digest(str(path)) for name, path in masks.items()}
    # known keypoints are found by the image's name
    named = isinstance(finder, KeypointSource)
    digests = [
        result_digest(options, beside + contents.get(name, "") + (name if named else ""), str(sha256))
        for sha256, name in zip(index.sha256[rows], names, strict=True)
    ]
    results = job.take_over(digests, _read_former)
    reused = len(results)
    progress = job.progress(len(rows), "images")
    progress.step(reused)
    missing = [place for place in range(len(rows)) if place not in results]
    sizes = [(width, height) for width, height in index.sizes[rows].tolist()]
    # who does not know a picture that lies on its side sees images as they are shown
    turned = options.method in LEARNED_DETECTORS or options.upright
    turns = index.orientations[rows].tolist() if turned else [1] * len(rows)
    for batch in in_batches([(sizes[place], turns[place]) for place in missing], job.network_batch()):
        places = [missing[part] for part in batch]
        images = [(names[place], sizes[place]) for place in places]
        wanted = [read_mask(masks[name], size) if name in masks else None for name, size in images]
        seen = [pictures.read(rows[place], options.max_shorter_side_px) for place in places]
        found = _extract(images, seen, wanted, [turns[place] for place in places], finder, options)
        results |= zip(places, found, strict=True)
        progress.step(len(places))
    ordered = [results[place] for place in range(len(rows))]
    _collect(index, rows, digests, ordered, finder).write(job.output, told.header)
    counts = [len(result.points) for result in ordered]
    bare = [name for name, count in zip(names, counts, strict=True) if count == 0]
    if bare:
        job.warn(
            f"{len(bare)} of {len(rows)} images have no keypoints and cannot be registered, such as "
            f"'{bare[0]}': the job's log says whether they could be read."
        )
    masked = f", {len(masks)} of them with masks" if masks else ""
    print(
        f"{len(rows)} images ({reused} taken over){masked}, {sum(counts)} keypoints, "
        f"median {int(np.median(counts)) if counts else 0} per image"
    )


def _find_masks(job: StageJob, names: Sequence[str]) -> dict[str, Path]:
    """The masks of the images that have one, by the image's name."""
    if not job.settings.get("masks"):
        return {}
    found = {name: find_mask(Path(job.settings["masks"]), name) for name in names}
    return {name: mask for name, mask in found.items() if mask is not None}


def _told_of_masks(job: StageJob) -> StageJob:
    """The job with what only the controller compares: the content of all masks, if there are any."""
    if not job.settings.get("masks"):
        return job
    cache_file = job.path("index").with_name(MASK_DIGESTS_NAME)
    content = fingerprint_images(Path(job.settings["masks"]), cache_file)
    return replace(job, settings={**job.settings, "masks_content": content})


def _create_finder(job: StageJob, options: "ExtractFeaturesOptions") -> Detector | KeypointSource:
    """What finds the keypoints in an image, or knows them by its name."""
    if options.method == "virtual":
        from snakesfm.evaluation.colmap_model import read_model
        from snakesfm.features.virtual import VirtualKeypoints

        model = read_model(Path(job.settings["reference"]))
        return VirtualKeypoints(model, options.surface_points, options.view_points)
    if options.method == "imported":
        return ImportedKeypoints(Path(job.settings["imported"]) / FEATURES)
    if options.method == "sift":
        return DETECTORS["sift"](
            contrast_threshold=options.contrast_threshold,
            edge_threshold=options.edge_threshold,
            upright=options.upright,
        )
    return DETECTORS[options.method](state=job.read_weights(options.method))


class ImportedKeypoints:
    """The keypoints of a file that hloc wrote, all of them; an image that it lacks has none.

    Where hloc saw an image in another size, its keypoints are scaled to the image that is here.

    Parameters
    ----------
    path : hloc's file of features.
    """

    descriptor_dtype: Any = np.float16
    usual_keypoints = 0

    def __init__(self, path: Path) -> None:
        self._file = open_hloc(path)
        self.descriptor_size = descriptor_size(self._file)
        self._told_of_scaling = False

    def read(self, name: str, size: tuple[int, int]) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.KeypointSource`.

        Raises
        ------
        ConfigError : the image's arrays do not fit together, or hloc saw it with another aspect.
        """
        columns = read_hloc_features(self._file, name)
        if columns is None:
            print(f"warning: {self._file.filename} has no keypoints for '{name}'")
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        columns["descriptors"] = self._of_one_length(columns["descriptors"], name)
        found_in = read_hloc_size(self._file, name) or size
        points = KeypointSet(
            columns["keypoints"],
            columns["descriptors"],
            columns["scores"],
            columns["scales"],
            columns["angles"],
            found_in,
        )
        return points if found_in == size else self._scaled(points, name, size)

    def _of_one_length(self, descriptors: Array, name: str) -> Array:
        """The descriptors (N,D) of an image, zeros where the other images alone have some."""
        count, length = descriptors.shape
        if length == self.descriptor_size:
            return descriptors
        if length:
            raise ConfigError(
                f"{self._file.filename} has descriptors of length {length} for '{name}', but of "
                f"{self.descriptor_size} for other images: use the features of one detector."
            )
        if count:
            print(f"warning: {self._file.filename} has no descriptors for '{name}'; zeros are used instead")
        return np.zeros((count, self.descriptor_size), self.descriptor_dtype)

    def _scaled(self, points: KeypointSet, name: str, size: tuple[int, int]) -> KeypointSet:
        """Keypoints of an image that hloc saw in another size, in the image's own pixels."""
        seen, here = ("{} x {}".format(*of) for of in (points.image_size, size))
        x, y = (own / other for own, other in zip(size, points.image_size, strict=True))
        if abs(x / y - 1) > ASPECT_TOLERANCE:
            raise ConfigError(
                f"{self._file.filename} has keypoints for '{name}' from an image of {seen} pixels, but "
                f"its file here has {here}: use the image that hloc read, or run hloc on this one without "
                "applying its EXIF orientation."
            )
        if not self._told_of_scaling:
            print(
                f"keypoints of {self._file.filename} are scaled to the size of the images here: "
                f"'{name}' had {seen} pixels and has {here}"
            )
        self._told_of_scaling = True
        return points.scaled(x, y)


def _extract(
    images: Sequence[tuple[str, tuple[int, int]]],
    pictures: Sequence[ImagePixels | None],
    masks: Sequence[Array | None],
    turns: Sequence[int],
    finder: Detector | KeypointSource,
    options: "ExtractFeaturesOptions",
) -> list[ColoredKeypoints]:
    """The keypoints of images, each given by its name and size, pixels, mask and orientation (EXIF)."""
    results = [_nothing(finder)] * len(images)
    pixels = {place: picture for place, picture in enumerate(pictures) if picture is not None}
    most = finder.usual_keypoints if options.max_keypoints == "auto" else options.max_keypoints
    if isinstance(finder, KeypointSource):
        found = [_read_known(finder, *images[place], masks[place]) for place in pixels]
        if options.method == "virtual":
            found = [points.take(np.argsort(-points.scores, kind="stable")[:most]) for points in found]
    else:
        seen = [
            (show_pixels(image.gray, turns[place]), show_pixels(image.rgb, turns[place]))
            for place, image in pixels.items()
        ]
        wanted = [
            mask if (mask := masks[place]) is None else show_pixels(mask, turns[place]) for place in pixels
        ]
        shown = extract_keypoints(finder, seen, most, options.max_shorter_side_px, wanted)
        found = [
            points.stored(turns[place]).scaled(image.reduction, image.reduction)
            for points, (place, image) in zip(shown, pixels.items(), strict=True)
        ]
    for (place, image), gapped in zip(pixels.items(), found, strict=True):
        points = _without_gaps(gapped, images[place][0])
        colors = sample_colors(image.rgb, points.keypoints / image.reduction)
        results[place] = ColoredKeypoints(points, colors)
    return results


def _read_known(
    source: KeypointSource, name: str, size: tuple[int, int], mask: Array | None
) -> KeypointSet:
    """The known keypoints of an image, but for those that its mask hides."""
    points = source.read(name, size)
    return points if mask is None else points.unmasked(mask, *size)


def _without_gaps(points: KeypointSet, name: str) -> KeypointSet:
    """Keypoints with zeros for descriptors that are not finite; none is dropped, as matches count them."""
    gaps = ~np.isfinite(points.descriptors).all(axis=1)
    if not gaps.any():
        return points
    print(
        f"warning: {gaps.sum()} of {len(points)} descriptors of '{name}' are not finite; zeros are used "
        "instead"
    )
    descriptors = points.descriptors.copy()
    descriptors[gaps] = 0
    return replace(points, descriptors=descriptors)


def _read_former(path: Path, wanted: set[str]) -> Mapping[str, ColoredKeypoints]:
    """What an earlier file holds of the images that are unchanged, by digest."""
    former = LocalFeatures.read_former(path)
    if former is None:
        return {}
    taken = {}
    for row, digest in enumerate(former.digests):
        if digest in wanted:
            part = slice(former.offsets[row], former.offsets[row + 1])
            points = KeypointSet(*(getattr(former, column)[part] for column in COLUMNS))
            taken[str(digest)] = ColoredKeypoints(points, former.colors[part])
    return taken


def _collect(
    index: ImageIndex,
    rows: Array,
    digests: list[str],
    results: list[ColoredKeypoints],
    finder: Detector | KeypointSource,
) -> LocalFeatures:
    nothing, *parts = (
        [*(getattr(result.points, column) for column in COLUMNS), result.colors]
        for result in (_nothing(finder), *results)
    )
    offsets, columns = join_parts(parts, nothing)
    return LocalFeatures(
        image_ids=rows,
        names=index.names[rows],
        sizes=index.sizes[rows],
        digests=np.array(digests, dtype=object),
        offsets=offsets,
        **dict(zip((*COLUMNS, "colors"), columns, strict=True)),
    )


def _nothing(finder: Detector | KeypointSource) -> ColoredKeypoints:
    """What an image without keypoints has."""
    points = KeypointSet.empty(finder.descriptor_size, finder.descriptor_dtype)
    return ColoredKeypoints(points, np.zeros((0, 3), np.uint8))
