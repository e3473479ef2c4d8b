"""Options of describe_images."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class DescribeImagesOptions(StageOptions):
    """How an image is summed up in one vector."""

    stage_version: ClassVar[int] = 1

    method: Literal["vlad"] = "vlad"
    """Global descriptor: VLAD of the local descriptors."""

    largest_share: float = Field(0.3, gt=0.0, le=1.0)
    """Share of each image's keypoints that takes part, those of largest scale first."""

    power: float = Field(0.5, gt=0.0, le=1.0)
    """Exponent of the power normalisation of the vector's entries (1 switches it off)."""
