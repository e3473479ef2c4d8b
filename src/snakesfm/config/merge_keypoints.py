"""Options of merge_keypoints."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class MergeKeypointsOptions(StageOptions):
    """How positions matched without keypoints are merged into keypoints; unused with a detector."""

    stage_version: ClassVar[int] = 2

    radius_px: float = Field(3.0, gt=0.0, le=100.0)
    """Positions in an image within this distance of a more confident one are merged into it."""
