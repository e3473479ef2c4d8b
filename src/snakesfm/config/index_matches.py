"""Options of index_matches."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class IndexMatchesOptions(StageOptions):
    """How matches without keypoints are expressed in merged keypoints; unused with keypoints."""

    stage_version: ClassVar[int] = 1

    max_distance_px: float = Field(3.0, gt=0.0, le=100.0)
    """Largest distance of a match's place from its keypoint; matches farther away are left out."""
