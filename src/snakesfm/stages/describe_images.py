"""Sum up every image of one block in a global descriptor."""

from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.features import GlobalDescriptors, LocalFeatures, Vocabulary
from snakesfm.retrieval.codebook import largest_rows
from snakesfm.retrieval.vlad import describe_vlad
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.describe_images import DescribeImagesOptions


def run(job: StageJob) -> None:
    """Describe the images one by one and write their GlobalDescriptors."""
    options: DescribeImagesOptions = job.options
    centers = Vocabulary.read(job.path("vocabulary")).centers
    with LocalFeatures.open(job.path("features")) as file:
        image_ids, offsets, descriptors = file["image_ids"][()], file["offsets"][()], file["descriptors"]
        described = np.zeros((len(image_ids), centers.size), np.float32)
        progress = job.progress(len(image_ids), "images")
        for row in range(len(image_ids)):
            rows = slice(offsets[row], offsets[row + 1])
            large = largest_rows(file["scales"][rows], options.largest_share)
            described[row] = describe_vlad(descriptors[rows][large], centers, options.power)
            progress.step()
    GlobalDescriptors(image_ids=image_ids, descriptors=described).write(job.output, job.header)
    print(f"{len(image_ids)} images described by {centers.size} numbers each")
