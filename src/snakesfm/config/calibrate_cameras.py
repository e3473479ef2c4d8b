"""Options of calibrate_cameras."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from snakesfm.config.base import StageOptions


class CalibrateCamerasOptions(StageOptions):
    """How unknown focal lengths are estimated before any pose is known."""

    stage_version: ClassVar[int] = 10

    estimate_focals: bool = True
    """Estimate unknown focal lengths from fundamental matrices; otherwise the priors are kept."""

    pairs_per_camera: int = Field(default=30, ge=1, le=1000)
    """Largest number of image pairs that vote on the focal length of a camera."""

    min_matches: int = Field(default=40, ge=8, le=10_000)
    """Pairs with fewer matches do not vote."""

    min_votes: int = Field(default=3, ge=1, le=100)
    """A focal length from EXIF is kept if fewer pairs vote; without EXIF one vote is enough."""

    max_error_px: float = Field(default=1.0, gt=0, le=20)
    """Largest epipolar error of a match that supports a fundamental matrix."""

    planar_ratio: float = Field(default=0.8, gt=0, le=1)
    """Pairs do not vote if a single homography explains this share of their inliers."""

    min_focal_ratio: float = Field(default=0.4, ge=0.01, le=10)
    """Smallest plausible focal length, relative to the longer image side."""

    max_focal_ratio: float = Field(default=6.0, gt=0, le=100)
    """Largest plausible focal length, relative to the longer image side."""

    systematic_sigma: float = Field(default=0.04, ge=0, le=1)
    """Relative error of an estimate that more pairs do not reduce: distortion, principal point."""

    max_sigma: float = Field(default=0.15, gt=0, le=10)
    """Estimates with a larger relative standard deviation are discarded, and the prior is kept."""

    exif_sigma: float = Field(default=0.03, ge=1e-4, le=10)
    """Relative standard deviation of a focal length from EXIF, as a prior."""

    default_sigma: float = Field(default=0.5, ge=1e-4, le=10)
    """Relative standard deviation of the default focal length, as a prior."""

    provisional_model: Literal["auto"] | bool = "auto"
    """Check estimated focal lengths with a quick model of the strongest pairs, and use its cameras if
    they differ; 'auto' does so if most images have a camera of their own."""

    provisional_pairs: int = Field(default=6, ge=2, le=1000)
    """Number of strongest pairs per image in the provisional model."""

    min_revision_sigmas: float = Field(default=2.0, ge=0, le=100)
    """The cameras of the provisional model are used if its focal lengths differ by more than this many
    standard deviations of the estimates, in the median."""

    overlay_share: float = Field(default=0.3, ge=0, le=1)
    """Matches that do not move are left out where this share of the pairs has such: a time stamp, a logo, a
    car's bonnet, the fixed background of a turntable (0: keep all)."""

    @model_validator(mode="after")
    def _refuse_an_empty_range(self) -> Self:
        if self.min_focal_ratio >= self.max_focal_ratio:
            raise ValueError(
                f"min_focal_ratio {self.min_focal_ratio:g} must be below max_focal_ratio "
                f"{self.max_focal_ratio:g}: lower the first or raise the second"
            )
        return self
