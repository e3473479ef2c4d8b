"""Options of learn_vocabulary."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class LearnVocabularyOptions(StageOptions):
    """How the codebook of local descriptors is learned on the scene."""

    stage_version: ClassVar[int] = 1

    words: int = Field(128, ge=2, le=4096)
    """Number of words (k-means clusters) of the codebook."""

    max_samples: int = Field(50_000, ge=1000, le=10_000_000)
    """Largest number of descriptors used for learning, drawn evenly from all images."""

    largest_share: float = Field(0.3, gt=0.0, le=1.0)
    """Share of each image's keypoints that is used, those with the largest scales."""

    iterations: int = Field(10, ge=1, le=1000)
    """Largest number of k-means iterations."""
