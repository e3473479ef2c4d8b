"""Options of average_translations."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class AverageTranslationsOptions(StageOptions):
    """Options of positioning the cameras, their rotations being known."""

    stage_version: ClassVar[int] = 11

    method: Literal["scale_chain", "translation_recovery", "global_positioning"] = "scale_chain"
    """Initial positions: from baseline ratios of shared landmarks, gtsam's TranslationRecovery, or
    pycolmap's global positioning."""

    refine: bool = True
    """Then refine camera centres and landmarks by the angular errors of the rays."""

    rays_per_camera: int = Field(default=100, ge=0)
    """Tracks are used, the longest first, until each camera has about this many rays."""

    recovery_rays_per_camera: int = Field(default=12, ge=0)
    """Approximate number of rays per camera in translation_recovery, which slows down with the number of
    landmarks; at most rays_per_camera."""

    ray_sigma_deg: float = Field(default=0.3, gt=0, le=10)
    """Expected error of a ray in degrees, mostly from its camera's averaged rotation."""

    restarts: int = Field(default=4, ge=0, le=100)
    """Random starts of global positioning with more rays, tried only if few rays agree with the positions
    (repeated facades); the positions with which most rays agree are kept (0: none)."""

    reject_outliers: Literal["mfas", "residual", "none"] = "residual"
    """How translation_recovery rejects edges: MFAS of 1DSfM, by the residuals of a first solution, or
    not at all."""

    mfas_projections: int = Field(default=100, ge=1)
    """Number of one-dimensional projections in MFAS."""

    mfas_weight: float = Field(default=0.125, ge=0, le=1)
    """MFAS rejects directions that are inconsistent in a larger share of the projections."""

    recovery_sigma: float = Field(default=0.01, gt=0)
    """Standard deviation of a direction, as a chord length, in translation_recovery."""

    positioning_loss_scale: float = Field(default=0.01, gt=0)
    """Scale of the Huber loss of global_positioning."""

    max_edge_residual_deg: float = Field(default=5.0, gt=0, le=180)
    """A two-view direction supports its cameras' positions if it differs from them by fewer degrees; in
    translation_recovery, 'residual' rejects the others."""

    min_support: int = Field(default=6, ge=1)
    """A camera keeps its position if at least this many of its rays agree with their landmarks."""

    min_support_ratio: float = Field(default=0.5, ge=0, le=1)
    """A camera keeps its position if at least this share of its rays agree with their landmarks."""

    max_relative_sigma: float = Field(default=0.1, gt=0)
    """Largest standard deviation of a camera centre, relative to the median distance to its landmarks."""
