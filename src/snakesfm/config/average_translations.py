"""Options of average_translations."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class AverageTranslationsOptions(StageOptions):
    """Options of positioning the cameras, their rotations being known."""

    stage_version: ClassVar[int] = 9

    method: Literal["scale_chain", "translation_recovery", "global_positioning"] = "scale_chain"
    """First guess: baselines compared by landmarks, gtsam's recovery, or pycolmap's global positioning."""

    refine: bool = True
    """Adjust centres and landmarks to the angles of the rays after the first guess."""

    rays_per_camera: int = Field(default=100, ge=0)
    """Tracks are taken, the longest first, until each camera has about so many rays."""

    recovery_rays_per_camera: int = Field(default=12, ge=0)
    """The same for translation_recovery, which slows down with the number of landmarks."""

    ray_sigma_deg: float = Field(default=0.3, gt=0, le=10)
    """Expected error of a ray, mostly that of its camera's averaged rotation."""

    edge_weight: float = Field(default=0.1, ge=0, le=1e6)
    """Weight of a two-view direction against that of a ray when the angles are refined."""

    reject_outliers: Literal["mfas", "residual", "none"] = "residual"
    """How translation_recovery refuses edges: MFAS of 1DSfM, or a first solution's residuals."""

    mfas_projections: int = Field(default=100, ge=1)
    """One-dimensional projections of MFAS."""

    mfas_weight: float = Field(default=0.125, ge=0, le=1)
    """MFAS refuses directions that are inconsistent in a larger share of the projections."""

    recovery_sigma: float = Field(default=0.01, gt=0)
    """Standard deviation of a direction, as a chord, in translation_recovery."""

    positioning_loss_scale: float = Field(default=0.01, gt=0)
    """Scale of the Huber loss of global_positioning."""

    positioning_start: Literal["random", "chain"] = "random"
    """Where global_positioning begins: anywhere, as in GLOMAP, or at the result of scale_chain."""

    max_edge_residual_deg: float = Field(default=5.0, gt=0, le=180)
    """Two-view directions that differ from the centres by more degrees are not counted as used."""

    min_support: int = Field(default=6, ge=1)
    """A camera keeps its centre when so many of its rays meet their landmarks."""

    min_support_ratio: float = Field(default=0.5, ge=0, le=1)
    """A camera keeps its centre when such a share of its rays meet their landmarks."""

    max_relative_sigma: float = Field(default=0.1, gt=0)
    """Largest standard deviation of a centre, relative to the median distance to the camera's landmarks."""
