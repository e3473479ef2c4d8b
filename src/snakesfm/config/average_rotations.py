"""Options of average_rotations."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class AverageRotationsOptions(StageOptions):
    """Options of averaging relative rotations to absolute ones."""

    stage_version: ClassVar[int] = 6

    method: Literal["two_stage", "irls", "shonan"] = "two_stage"
    """Averager: robust pass and covariance-weighted refinement, L1 and IRLS only, or Shonan averaging (with
    the Huber loss and without a certificate where gtsam fails otherwise)."""

    max_residual_deg: float = Field(default=10.0, gt=0, le=180)
    """Edges that differ from the averaged rotations by more than a limit are refused; it adapts to the
    scene, up to this value in degrees."""

    min_residual_deg: float = Field(default=5.0, ge=0, le=180)
    """Lower bound of that limit, in degrees."""

    min_component_images: int = Field(default=5, ge=3)
    """Smallest number of images (at least 3) for which a component besides the largest becomes a model
    of its own."""
