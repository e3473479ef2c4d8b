"""Options of extract_features."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from snakesfm.config.base import StageOptions
from snakesfm.geometry.detector_sides import USUAL_SIDE_PX


class ExtractFeaturesOptions(StageOptions):
    """How keypoints are found and described."""

    stage_version: ClassVar[int] = 6

    method: Literal["sift", "aliked", "disk", "xfeat", "superpoint", "virtual", "imported"] = "sift"
    """SIFT with RootSIFT descriptors, a network, an oracle, or hloc's file; see docs/front_ends.md."""

    max_keypoints: Annotated[int, Field(ge=16, le=100_000)] | Literal["auto"] = "auto"
    """Largest number of keypoints per image, the strongest first; 'auto' is 5000 for SIFT, 2048 for a
    network."""

    surface_points: int = Field(0, ge=0, le=1_000_000)
    """Number of points 'virtual' samples on a surface through the reference's points; 0 uses these
    points themselves."""

    view_points: int = Field(0, ge=0, le=100_000)
    """Number of points 'virtual' spreads over the view of each image, without occlusion; 0 turns this
    off."""

    max_shorter_side_px: int = Field(USUAL_SIDE_PX, ge=64, le=20_000)
    """Shorter side to which larger images are scaled down before keypoints are detected; raise
    max_keypoints with it. Keypoint coordinates stay in original pixels."""

    contrast_threshold: float = Field(0.01, ge=0.0, le=0.5)
    """Smallest contrast of a SIFT keypoint, as in OpenCV; lower values find more keypoints in
    low-contrast images."""

    upright: bool = False
    """Describe keypoints without their orientation: more matches, but none between images rotated about
    the viewing axis. EXIF orientations are heeded."""

    edge_threshold: float = Field(10.0, gt=1.0, le=100.0)
    """Largest ratio of principal curvatures of a SIFT keypoint; lower values reject more points on
    edges."""

    @model_validator(mode="after")
    def _refuse_two_kinds_of_points(self) -> Self:
        if self.surface_points and self.view_points:
            raise ValueError("surface_points and view_points cannot be combined: set one of them to 0")
        return self
