"""Options of evaluate_model."""

from typing import Annotated, ClassVar

from pydantic import Field

from snakesfm.config.base import StageOptions

Degrees = Annotated[float, Field(gt=0.0, le=180.0)]


class EvaluateModelOptions(StageOptions):
    """Thresholds of the metrics."""

    stage_version: ClassVar[int] = 6

    relative_thresholds_deg: tuple[Degrees, ...] = Field(default=(1.0, 3.0, 5.0, 10.0, 20.0), min_length=1)
    """Thresholds of the AUC over the relative poses of all pairs of reference images, in degrees."""

    global_thresholds_deg: tuple[Degrees, ...] = Field(default=(1.0, 2.5, 5.0, 10.0, 20.0), min_length=1)
    """Thresholds of the AUC over the poses of all reference images after alignment, in degrees."""

    min_baseline_ratio: float = Field(default=1e-6, ge=0.0, le=1.0)
    """Reference images closer together than this share of the reference's extent are compared by
    rotation only."""
