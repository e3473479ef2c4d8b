"""Options of estimate_two_view."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class EstimateTwoViewOptions(StageOptions):
    """How the relative pose of a pair is estimated, refined and accepted."""

    stage_version: ClassVar[int] = 5

    estimator: Literal["poselib", "opencv_gcransac", "opencv_magsac", "pycolmap"] = "poselib"
    """Robust estimator of the essential matrix."""

    max_error_px: float = Field(default=0.5, gt=0, le=20)
    """Sampson error up to which a match supports a hypothesis of the robust estimator."""

    adapt_error: bool = True
    """Estimate again with a threshold of three times the measured noise where that is much larger."""

    max_adapted_error_px: float = Field(default=3.0, gt=0, le=50)
    """Upper bound of the adapted threshold."""

    max_iterations: int = Field(default=250, ge=10, le=1_000_000)
    """Upper bound of the hypotheses of one robust estimation."""

    refine: Literal["none", "sampson", "bundle"] = "sampson"
    """Refinement: none, on the Sampson error, or two-view bundle adjustment with triangulated points."""

    loss_scale: float = Field(default=1.0, gt=0, le=20)
    """Scale of the Cauchy loss of the refinement, in standard deviations of the measured noise."""

    inlier_error_px: float = Field(default=2.0, gt=0, le=20)
    """Sampson error up to which a match is handed on to the tracks; four times the noise where larger."""

    min_inliers: int = Field(default=15, ge=6, le=10_000)
    """Pairs with fewer inlier matches are rejected."""

    min_inlier_ratio: float = Field(default=0.1, ge=0, le=1)
    """Pairs with a smaller share of inliers among their matches are rejected."""

    ratio_of: Literal["estimator", "refined"] = "refined"
    """Whether the inlier ratio is taken of the robust estimator's inliers or of those after refinement."""

    min_significance: float = Field(default=3.0, ge=0, le=1000)
    """Pairs whose inliers chance would give more often than 10^-x are rejected; 0 turns it off."""

    min_support: float = Field(default=10.0, ge=0, le=10_000)
    """Pairs whose inlier count times inlier ratio is smaller are rejected; 0 turns it off."""

    max_rotation_std_deg: float = Field(default=5.0, gt=0, le=180)
    """Pairs whose rotation is less certain than this standard deviation are rejected as indeterminate."""

    min_ambiguity_gap: float = Field(default=20.0, ge=0, le=10_000)
    """Pairs are rejected where another pose of a plane has a log-likelihood within this; 0 turns it off."""

    planar_ratio: float = Field(default=0.8, gt=0, le=1)
    """A pair is planar where a homography explains this share of the inliers."""

    rotation_only_angle_deg: float = Field(default=0.5, ge=0, le=30)
    """A pair may be rotation-only where the median triangulation angle is below this."""
