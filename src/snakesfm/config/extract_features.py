"""Options of extract_features."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from snakesfm.config.base import StageOptions


class ExtractFeaturesOptions(StageOptions):
    """How keypoints are found and described."""

    stage_version: ClassVar[int] = 4

    method: Literal["sift", "aliked", "disk", "xfeat", "superpoint", "virtual", "imported"] = "sift"
    """SIFT with RootSIFT descriptors, a network, an oracle, or hloc's file: see docs/front_ends.md."""

    max_keypoints: Annotated[int, Field(ge=16, le=100_000)] | Literal["auto"] = "auto"
    """Most keypoints kept per image, the strongest first; 'auto': 5000 of SIFT, 2048 of a network."""

    surface_points: int = Field(0, ge=0, le=1_000_000)
    """Points that 'virtual' takes from a surface through the reference's points (0: these themselves)."""

    view_points: int = Field(0, ge=0, le=100_000)
    """Points that 'virtual' spreads over each image's view, hidden by nothing (0: none)."""

    max_shorter_side_px: int = Field(760, ge=64, le=20_000)
    """Shorter side to which larger images are scaled down; keypoints stay in original pixels."""

    contrast_threshold: float = Field(0.01, ge=0.0, le=0.5)
    """Least contrast of a SIFT keypoint, as in OpenCV; lower finds more keypoints in flat images."""

    upright: bool = False
    """Describe keypoints upright: more matches, but none between cameras turned about their axis."""

    edge_threshold: float = Field(10.0, gt=1.0, le=100.0)
    """Largest ratio of principal curvatures of a SIFT keypoint; lower refuses more points on edges."""

    @model_validator(mode="after")
    def _refuse_two_kinds_of_points(self) -> Self:
        if self.surface_points and self.view_points:
            raise ValueError("surface_points and view_points are two kinds of points: set one of them to 0")
        return self
