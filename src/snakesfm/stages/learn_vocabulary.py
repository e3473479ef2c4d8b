"""Learn the codebook of local descriptors on the scene."""

from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.features import LocalFeatures, Vocabulary
from snakesfm.retrieval.codebook import largest_rows, learn_codebook, sample_rows
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.learn_vocabulary import LearnVocabularyOptions


def run(job: StageJob) -> None:
    """Sample descriptors of all images evenly, cluster them and write the Vocabulary."""
    options: LearnVocabularyOptions = job.options
    paths = job.paths("features")
    image_count = 0
    for path in paths:
        with LocalFeatures.open(path) as file:
            image_count += len(file["image_ids"])
    per_image = -(-options.max_samples // max(image_count, 1))
    sampled = {}
    for path in paths:
        with LocalFeatures.open(path) as file:
            offsets, descriptors = file["offsets"][()], file["descriptors"]
            for row, (image, name) in enumerate(zip(file["image_ids"], file["names"].asstr(), strict=True)):
                rows = slice(offsets[row], offsets[row + 1])
                large = largest_rows(file["scales"][rows], options.largest_share)
                drawn = large[sample_rows(len(large), per_image, job.seed_for(name))]
                sampled[int(image)] = descriptors[rows][drawn]
            size, dtype = descriptors.shape[1], descriptors.dtype
    # in the order of the index, so that the blocks play no part
    samples = np.concatenate([np.zeros((0, size), dtype), *(sampled[image] for image in sorted(sampled))])
    centers = learn_codebook(samples, options.words, options.iterations, job.seed_for("codebook"))
    Vocabulary(centers=centers).write(job.output, job.header)
    print(f"{len(centers)} words from {len(samples)} descriptors of {image_count} images")
