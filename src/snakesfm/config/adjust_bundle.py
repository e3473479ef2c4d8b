"""Options of adjust_bundle."""

from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from snakesfm.config.base import StageOptions


class AdjustBundleOptions(StageOptions):
    """How cameras, poses and points are adjusted together."""

    stage_version: ClassVar[int] = 16

    solver: Literal["ceres", "gtsam"] = "ceres"
    """Least-squares solver: Ceres through pycolmap, or gtsam (slower, fewer camera models)."""

    thresholds_px: tuple[Annotated[float, Field(gt=0.0)], ...] = Field(
        default=(10.0, 5.0, 3.0), min_length=1, max_length=10
    )
    """Largest reprojection error of an observation after each of the chained rounds."""

    loss: Literal["huber", "cauchy", "squared"] = "cauchy"
    """Robust loss of the reprojection errors in all passes but the last."""

    loss_scale_px: Literal["auto"] | Annotated[float, Field(gt=0.0, le=100.0)] = "auto"
    """Reprojection error from which on the loss of the last round grows more slowly; 'auto' measures it."""

    loss_scale_sigmas: float = Field(default=3.5, gt=0.0, le=100.0)
    """What 'auto' takes: so many standard deviations of the keypoints' noise; 2.4 without refinement."""

    early_loss_share: float = Field(default=0.4, gt=0.0, le=10.0)
    """The same of earlier rounds, as a share of the round's threshold: a bad start needs a wide loss."""

    outlier_sigmas: float = Field(default=12.0, ge=3.0, le=1000.0)
    """Before the last pass, observations off by more standard deviations of the noise are dropped."""

    last_loss: Literal["huber", "cauchy", "squared"] = "huber"
    """Loss of the last pass, which has no far outliers, so that the tails may weigh more."""

    rotations_first: bool = False
    """Start with a pass that holds the averaged rotations fixed."""

    refine_focal: bool = True
    """Refine the focal length of cameras that are not fixed."""

    refine_distortion: bool = True
    """Refine the distortion of cameras that are not fixed."""

    distortion_from_round: int = Field(default=2, ge=1)
    """Round from which on distortion is refined, the last at the latest."""

    refine_principal_points: bool = True
    """At the end, refine principal points of cameras that are not fixed, where the model tells them."""

    max_principal_point_gap: float = Field(default=0.003, gt=0.0, le=1.0)
    """Distance, over the longer side, up to which two halves of the points must tell it alike."""

    min_principal_point_offset: float = Field(default=0.004, ge=0.0, le=1.0)
    """Distance from the start, over the longer side, below which a principal point stays where it was."""

    max_principal_point_offset: float = Field(default=0.02, gt=0.0, le=1.0)
    """Distance from the start, over the longer side, beyond which a principal point is not believed."""

    max_focal_change: float = Field(default=3.0, gt=1.0)
    """Factor by which a focal length of EXIF may change before the camera is reset and held in the pass."""

    max_guessed_focal_change: float = Field(default=15.0, gt=1.0)
    """The same without EXIF, as a factor of 1.2 times the longer side."""

    max_distortion: float = Field(default=1.0, gt=0.0)
    """Largest distortion by all terms, as a k of SIMPLE_RADIAL, before the camera is reset and held."""

    complete_tracks: bool = True
    """Between rounds, add observations to points, merge points, and make points of left-out matches."""

    complete_error_px: float = Field(default=4.0, gt=0.0)
    """Largest reprojection error of an observation that completion adds."""

    complete_refused_pairs: bool = True
    """Complete by the matches of refused pairs too, but for ambiguous ones, whose pose may be wrong."""

    refine_keypoints: Literal["auto"] | bool = "auto"
    """Move each point's observations to where pixels agree best; 'auto': if most images share a camera."""

    refine_finenesses: tuple[Annotated[float, Field(ge=0.1, le=16.0)], ...] = Field(
        default=(1.0, 2.0), min_length=1, max_length=8
    )
    """Keypoints are refined in images so many times finer than the detector saw, one after the other."""

    refine_radius_px: int = Field(default=5, ge=2, le=30)
    """Half the side of the patch around a keypoint that is compared, at fineness 1; 1.6 times that at 2."""

    refine_min_correlation: float = Field(default=0.8, ge=0.0, lt=1.0)
    """Correlation from which on a refined keypoint is taken; others stay where they were found."""

    register_images: bool = True
    """Register images that averaging or adjustment left out by their matches to points."""

    register_min_inliers: int = Field(default=15, ge=6)
    """Points that a newly registered image must agree with."""

    register_min_ratio: float = Field(default=0.25, ge=0.0, le=1.0)
    """Share of its matched points that a newly registered image must agree with."""

    register_error_px: float = Field(default=6.0, gt=0.0)
    """Largest reprojection error of an inlier of a registration."""

    min_angle_deg: float = Field(default=1.0, ge=0.0, lt=90.0)
    """Smallest angle between the rays to a point of the model."""

    min_track_length: int = Field(default=3, ge=2)
    """Observations that a point must have to take part; 2 where only two images are posed."""

    sparse_observations: int = Field(default=100, ge=0)
    """An image with fewer observations of such points keeps its points of two images too."""

    min_observations: int = Field(default=10, ge=0)
    """Observations that an image must have to stay registered."""

    select_above_images: int = Field(default=500, ge=0)
    """Registered images above which passes of the solver may work on a selection of the points."""

    early_observations: int = Field(default=300, ge=0)
    """Then, observations per image that early rounds adjust, those of the longest tracks; 0 for all."""

    final_observations: int = Field(default=0, ge=0)
    """The same in the last round and later ones; 0 for all."""

    max_iterations: Annotated[int, Field(ge=1, le=1_000_000)] | Literal["auto"] = "auto"
    """Iterations of the solver per pass; 'auto' is 50, up to 500 where a small model makes them cheap."""

    function_tolerance: float = Field(default=3e-6, gt=0.0)
    """Relative decrease of the cost at which the last pass ends; earlier ones end at 300 times as much."""

    @model_validator(mode="after")
    def _refine_in_ever_finer_images(self) -> Self:
        if any(finer <= coarser for coarser, finer in pairwise(self.refine_finenesses)):
            raise ValueError("refine_finenesses must ascend: each is for images finer than those before")
        return self
