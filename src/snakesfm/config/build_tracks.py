"""Options of build_tracks."""

from typing import ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions


class BuildTracksOptions(StageOptions):
    """How matches are joined to tracks."""

    stage_version: ClassVar[int] = 7

    min_length: int = Field(default=3, ge=2)
    """Number of images that a track must be seen in; 2 if only two images have a rotation."""

    sparse_observations: int = Field(default=100, ge=0)
    """An image with fewer observations of such tracks also keeps its tracks of two images."""

    merge_radius_px: float = Field(default=1.0, ge=0.0, le=20.0)
    """Keypoints of one image closer together than this count as one observation of a track."""
