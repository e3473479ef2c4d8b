"""Options of triangulate_tracks."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class TriangulateTracksOptions(StageOptions):
    """How tracks are triangulated."""

    stage_version: ClassVar[int] = 3

    method: Literal["ransac_dlt", "pycolmap"] = "ransac_dlt"
    """RANSAC over pairs of observations with a linear solution from the inliers, or pycolmap's
    LO-RANSAC."""

    max_hypotheses: int = Field(default=100, ge=1, le=10_000)
    """Largest number of observation pairs tried per track."""

    max_reprojection_error_px: float = Field(default=60.0, gt=0.0)
    """Observations with a larger reprojection error are dropped; wide, because averaged poses are
    approximate."""

    min_angle_deg: float = Field(default=1.0, ge=0.0, lt=90.0)
    """Smallest angle in degrees between the rays to a point."""

    min_length: int = Field(default=2, ge=2)
    """Smallest number of observations of a point."""
