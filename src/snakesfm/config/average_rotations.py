"""Options of average_rotations."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class AverageRotationsOptions(StageOptions):
    """Options of averaging relative rotations to absolute ones."""

    stage_version: ClassVar[int] = 6

    method: Literal["two_stage", "irls", "shonan"] = "two_stage"
    """Averager: robust pass and covariance-weighted refinement, L1 and IRLS only, or Shonan averaging."""

    max_residual_deg: float = Field(default=10.0, gt=0, le=180)
    """Edges are refused that differ from the averaged rotations by more degrees than this."""

    min_residual_deg: float = Field(default=5.0, ge=0, le=180)
    """The limit adapts to the residuals of the scene, but not below so many degrees."""

    passes: int = Field(default=2, ge=1, le=5)
    """How often the rotations are averaged; then edges are refused or taken back by residuals."""

    min_component_images: int = Field(default=5, ge=3)
    """Images, three or more, that a part of the graph needs to be a model of its own beside the largest."""
