"""Options of describe_images."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class DescribeImagesOptions(StageOptions):
    """How an image is summarised in one vector."""

    stage_version: ClassVar[int] = 4

    method: Literal["vlad", "netvlad", "megaloc"] = "vlad"
    """Global descriptor: VLAD of the local descriptors, or a network applied to the whole image."""

    largest_share: float = Field(0.3, gt=0.0, le=1.0)
    """Share of each image's keypoints that is used, those with the largest scales."""

    power: float = Field(0.5, gt=0.0, le=1.0)
    """Exponent of the power normalisation of the vector's entries; 1 turns it off."""

    longer_side_px: Annotated[int, Field(ge=28, le=20_000)] | Literal["auto"] = "auto"
    """Longer side to which images are scaled down for a network; 'auto' is 640 for netvlad, 322 for
    megaloc."""
