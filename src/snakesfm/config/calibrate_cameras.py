"""Options of calibrate_cameras."""

from typing import ClassVar, Self

from pydantic import Field, model_validator

from snakesfm.config.base import StageOptions


class CalibrateCamerasOptions(StageOptions):
    """How unknown focal lengths are estimated before any pose is known."""

    stage_version: ClassVar[int] = 5

    estimate_focals: bool = True
    """Estimate focal lengths that are not given from fundamental matrices; otherwise priors are kept."""

    pairs_per_camera: int = Field(default=30, ge=1, le=1000)
    """Upper bound of the image pairs that vote on the focal length of one camera."""

    min_matches: int = Field(default=40, ge=8, le=10_000)
    """Pairs with fewer matches do not vote."""

    min_votes: int = Field(default=3, ge=1, le=100)
    """Focal lengths in EXIF stay where fewer pairs vote; without EXIF one vote is enough."""

    max_error_px: float = Field(default=1.0, gt=0, le=20)
    """Epipolar error up to which a match supports a fundamental matrix."""

    planar_ratio: float = Field(default=0.8, gt=0, le=1)
    """Pairs whose inliers one homography explains by this share do not vote."""

    min_focal_ratio: float = Field(default=0.4, gt=0, le=10)
    """Smallest believable focal length over the larger image side."""

    max_focal_ratio: float = Field(default=6.0, gt=0, le=100)
    """Largest believable focal length over the larger image side."""

    systematic_sigma: float = Field(default=0.04, ge=0, le=1)
    """Relative error of an estimate that no number of pairs takes away: distortion, principal point."""

    max_sigma: float = Field(default=0.15, gt=0, le=10)
    """Estimates with a larger relative standard deviation are not used; the prior is kept."""

    exif_sigma: float = Field(default=0.03, gt=0, le=10)
    """Relative standard deviation of focal lengths from EXIF, as a prior."""

    default_sigma: float = Field(default=0.5, gt=0, le=10)
    """Relative standard deviation of the default focal length, as a prior."""

    @model_validator(mode="after")
    def _refuse_an_empty_range(self) -> Self:
        if self.min_focal_ratio >= self.max_focal_ratio:
            raise ValueError(
                f"min_focal_ratio {self.min_focal_ratio:g} must be below max_focal_ratio "
                f"{self.max_focal_ratio:g}: lower the one or raise the other"
            )
        return self
