"""Options of index_matches."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class IndexMatchesOptions(StageOptions):
    """How matches found without keypoints are assigned to merged keypoints; unused with a detector."""

    stage_version: ClassVar[int] = 1

    max_distance_px: float = Field(3.0, gt=0.0, le=100.0)
    """Largest distance of a matched position from its keypoint; matches farther away are dropped."""
