"""Options of extract_features."""

from typing import ClassVar, Literal

from pydantic import Field

from snakesfm.config.base import StageOptions


class ExtractFeaturesOptions(StageOptions):
    """How keypoints are found and described."""

    stage_version: ClassVar[int] = 1

    method: Literal["sift"] = "sift"
    """Detector and descriptor: SIFT with RootSIFT descriptors."""

    max_keypoints: int = Field(5000, ge=16, le=100_000)
    """Most keypoints kept per image, the strongest first."""

    max_shorter_side_px: int = Field(760, ge=64, le=20_000)
    """Shorter side to which larger images are scaled down; keypoints stay in original pixels."""

    contrast_threshold: float = Field(0.01, ge=0.0, le=0.5)
    """Least contrast of a SIFT keypoint, as in OpenCV; lower finds more keypoints in flat images."""

    upright: bool = False
    """Describe keypoints upright: more matches, but none between cameras turned about their axis."""

    edge_threshold: float = Field(10.0, ge=1.0, le=100.0)
    """Largest ratio of principal curvatures of a SIFT keypoint; lower refuses more points on edges."""
