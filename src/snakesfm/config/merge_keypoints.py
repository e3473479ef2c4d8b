"""Options of merge_keypoints."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class MergeKeypointsOptions(StageOptions):
    """How the places that a matcher without keypoints finds become keypoints; unused with keypoints."""

    stage_version: ClassVar[int] = 2

    radius_px: float = Field(3.0, gt=0.0, le=100.0)
    """Places of an image within this distance of a surer one are merged into it."""
