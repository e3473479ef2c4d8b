"""Compute a global descriptor for every image of one block."""

import math
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.features import GlobalDescriptors, LocalFeatures, Vocabulary
from snakesfm.artifacts.images import ImageIndex
from snakesfm.geometry.orientations import show_pixels
from snakesfm.learned.batches import in_batches
from snakesfm.retrieval.codebook import largest_rows
from snakesfm.retrieval.descriptor import DESCRIPTORS, describe_batch
from snakesfm.retrieval.vlad import describe_vlad
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.describe_images import DescribeImagesOptions


def run(job: StageJob) -> None:
    """Describe the images and write their GlobalDescriptors.

    Raises
    ------
    SceneError : an image cannot be read now, or is another than when it was indexed.
    """
    options: DescribeImagesOptions = job.options
    describe = _describe_local_features if options.method == "vlad" else _describe_pictures
    image_ids, described = describe(job, options)
    GlobalDescriptors(image_ids=image_ids, descriptors=described).write(job.output, job.header)
    print(f"{len(image_ids)} images described by {described.shape[1]} numbers each")


def _describe_local_features(job: StageJob, options: "DescribeImagesOptions") -> tuple[Array, Array]:
    """Rows (n,) of the index and descriptors (n,D) of the block's images, from their keypoints."""
    centers = Vocabulary.read(job.paths("vocabulary")[0]).centers
    with LocalFeatures.open(job.paths("features")[0]) as file:
        image_ids, offsets, descriptors = file["image_ids"][()], file["offsets"][()], file["descriptors"]
        described = np.zeros((len(image_ids), centers.size), np.float32)
        progress = job.progress(len(image_ids), "images")
        for row in range(len(image_ids)):
            rows = slice(offsets[row], offsets[row + 1])
            large = largest_rows(file["scales"][rows], options.largest_share)
            described[row] = describe_vlad(descriptors[rows][large], centers, options.power)
            progress.step()
    return image_ids, described


def _describe_pictures(job: StageJob, options: "DescribeImagesOptions") -> tuple[Array, Array]:
    """The same from the images themselves; one that cannot be decoded resembles none."""
    from snakesfm.ingest.indexed import IndexedImages

    index = ImageIndex.read(job.paths("index")[0])
    image_ids = np.flatnonzero(index.blocks == int(job.settings["block"]))
    descriptor = DESCRIPTORS[options.method](state=job.read_weights(options.method))
    side = descriptor.usual_side_px if options.longer_side_px == "auto" else options.longer_side_px
    described = np.zeros((len(image_ids), descriptor.size), np.float32)
    images = IndexedImages(index.names, index.sha256, job.settings["images"])
    progress = job.progress(len(image_ids), "images")
    for rows in in_batches([tuple(size) for size in index.sizes[image_ids].tolist()], job.network_batch()):
        pictures = {}
        for row in rows:
            image = image_ids[row]
            width, height = index.sizes[image].tolist()
            shorter = math.ceil(side * min(width, height) / max(width, height))
            shorter = max(shorter, descriptor.smallest_side_px)
            pixels = images.read(image, shorter)
            if pixels is not None:
                pictures[row] = show_pixels(pixels.rgb, int(index.orientations[image]))
        described[list(pictures)] = describe_batch(descriptor, list(pictures.values()), side)
        progress.step(len(rows))
    if images.damaged:
        job.warn(
            f"{len(images.damaged)} of {len(image_ids)} images cannot be read and so resemble no other: "
            f"{next(iter(images.damaged.values()))}"
        )
    return image_ids.astype(np.int32), described
