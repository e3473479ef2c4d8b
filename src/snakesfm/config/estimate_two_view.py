"""Options of estimate_two_view."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class EstimateTwoViewOptions(StageOptions):
    """How the relative pose of a pair is estimated, refined and accepted."""

    stage_version: ClassVar[int] = 6

    estimator: Literal["poselib", "opencv_gcransac", "pycolmap"] = "poselib"
    """Robust estimator of the essential matrix."""

    max_error_px: float = Field(default=0.5, gt=0, le=20)
    """Largest Sampson error of a match that supports a hypothesis of the robust estimator."""

    adapt_error: bool = True
    """Estimate again with three times the measured noise as threshold if max_error_px is much smaller."""

    max_adapted_error_px: float = Field(default=3.0, gt=0, le=50)
    """Upper bound of the adapted threshold."""

    max_iterations: int = Field(default=250, ge=10, le=1_000_000)
    """Largest number of hypotheses per robust estimation."""

    refine: Literal["none", "sampson", "bundle"] = "sampson"
    """Refinement: none, on the Sampson error, or two-view bundle adjustment with triangulated points."""

    loss_scale: float = Field(default=1.0, gt=0, le=20)
    """Scale of the Cauchy loss of the refinement, in standard deviations of the measured noise."""

    inlier_error_px: float = Field(default=2.0, gt=0, le=20)
    """Largest Sampson error of a match that is used for tracks, or four times the noise if that is
    larger."""

    min_inliers: int = Field(default=15, ge=6, le=10_000)
    """Pairs with fewer inlier matches are rejected."""

    min_inlier_ratio: float = Field(default=0.1, ge=0, le=1)
    """Pairs with a smaller share of inliers among their matches are rejected."""

    min_significance: float = Field(default=3.0, ge=0, le=1000)
    """Pairs are rejected if chance alone would produce their inliers with an expected count above
    10^-x; 0 turns this off."""

    min_support: float = Field(default=10.0, ge=0, le=10_000)
    """Pairs are rejected if inlier count times inlier ratio is smaller; 0 turns this off."""

    max_rotation_std_deg: float = Field(default=5.0, gt=0, le=180)
    """Pairs are rejected as indeterminate if the standard deviation of their rotation, in degrees, is
    larger."""

    min_ambiguity_gap: float = Field(default=20.0, ge=0, le=10_000)
    """Pairs are rejected as ambiguous if another pose that their plane allows is less likely by less
    than this log-likelihood; 0 turns this off."""

    planar_ratio: float = Field(default=0.8, gt=0, le=1)
    """A pair is planar if a homography explains this share of its inliers."""

    rotation_only_angle_deg: float = Field(default=0.5, ge=0, le=30)
    """A pair can be rotation-only if its median triangulation angle, in degrees, is smaller."""
