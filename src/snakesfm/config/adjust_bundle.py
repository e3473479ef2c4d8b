"""Options of adjust_bundle."""

from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from snakesfm.config.base import StageOptions


class AdjustBundleOptions(StageOptions):
    """How cameras, poses and points are adjusted together."""

    stage_version: ClassVar[int] = 20

    solver: Literal["ceres", "gtsam"] = "ceres"
    """Least-squares solver: Ceres through pycolmap, or gtsam (slower, fewer camera models; principal
    points are not refined, and fisheye lenses not recognised)."""

    thresholds_px: tuple[Annotated[float, Field(gt=0.0)], ...] = Field(
        default=(10.0, 5.0, 3.0), min_length=1, max_length=10
    )
    """Largest reprojection error of an observation after each round; one round per value."""

    loss: Literal["huber", "cauchy", "squared"] = "cauchy"
    """Robust loss on the reprojection errors in all passes but the last."""

    loss_scale_px: Literal["auto"] | Annotated[float, Field(ge=1e-3, le=100.0)] = "auto"
    """Reprojection error above which the loss of the last round grows more slowly; 'auto' measures the
    keypoint noise and uses loss_scale_sigmas times its standard deviation."""

    loss_scale_sigmas: float = Field(default=3.5, ge=1e-3, le=100.0)
    """Loss scale that loss_scale_px 'auto' uses, in standard deviations of the keypoint noise; 2.4 is
    better without keypoint refinement."""

    early_loss_share: float = Field(default=0.4, ge=1e-3, le=10.0)
    """Loss scale of the earlier rounds as a fraction of the round's threshold; wide, because the start
    is poor."""

    outlier_sigmas: float = Field(default=12.0, ge=3.0, le=1000.0)
    """Before the last pass, observations with errors above this many standard deviations of the
    keypoint noise are dropped."""

    last_loss: Literal["huber", "cauchy", "squared"] = "huber"
    """Robust loss of the last pass, when far outliers are gone and larger errors may have more weight."""

    refine_focal: bool = True
    """Refine the focal length of cameras that are not fixed."""

    refine_distortion: bool = True
    """Refine the distortion of cameras that are not fixed, from the second round on."""

    refine_principal_points: bool = True
    """At the end, refine the principal points of cameras that are not fixed, if the model determines
    them."""

    max_principal_point_gap: float = Field(default=0.003, gt=0.0, le=1.0)
    """Largest difference, relative to the longer side, between the principal points estimated from two
    halves of the points; a tenth of the distance moved is allowed as well."""

    min_principal_point_offset: float = Field(default=0.004, ge=0.0, le=1.0)
    """A principal point is left unchanged if it would move by less than this, relative to the longer
    side."""

    max_principal_point_offset: float = Field(default=0.02, gt=0.0, le=1.0)
    """A principal point that would move by more than this, relative to the longer side, must clearly lower
    the reprojection errors, or it is left unchanged with a warning."""

    max_focal_change: float = Field(default=3.0, gt=1.0)
    """Factor by which a focal length that is given or from EXIF may change before the camera is reset
    and kept fixed for the pass."""

    max_guessed_focal_change: float = Field(default=15.0, gt=1.0)
    """Factor by which any other focal length, also one from matches, may differ from 1.2 times the
    longer side before the camera is reset and kept fixed for the pass."""

    max_distortion: float = Field(default=1.0, gt=0.0)
    """Distortion above which a camera is reset and kept fixed for the pass, as the k of an equally
    strong SIMPLE_RADIAL camera."""

    complete_tracks: bool = True
    """Between rounds, add observations to points, merge points, and triangulate points from unused
    matches."""

    complete_error_px: float = Field(default=4.0, gt=0.0)
    """Largest reprojection error of an observation added by completion."""

    complete_refused_pairs: bool = True
    """Also use the matches of rejected pairs for completion, except ambiguous pairs, whose pose may be
    wrong."""

    refine_keypoints: Literal["auto"] | bool = "auto"
    """Refine keypoints by aligning image patches across views; 'auto' does so if most images share a
    camera."""

    refine_finenesses: tuple[Annotated[float, Field(ge=0.1, le=16.0)], ...] = Field(
        default=(1.0, 2.0), min_length=1, max_length=8
    )
    """Image resolutions at which keypoints are refined, one after the other, as multiples of the
    detector's."""

    refine_radius_px: int = Field(default=5, ge=2, le=30)
    """Half the side of the patches that are compared, in pixels at fineness 1; 1.6 times as many at
    fineness 2."""

    refine_min_correlation: float = Field(default=0.8, ge=0.0, lt=1.0)
    """Smallest patch correlation at which a refined position is used; other keypoints stay where they
    were detected."""

    register_images: bool = True
    """Register images left out by averaging or adjustment, by their matches to points of the model."""

    register_min_inliers: int = Field(default=15, ge=6)
    """Smallest number of inlier points of a newly registered image."""

    register_min_ratio: float = Field(default=0.25, ge=0.0, le=1.0)
    """Smallest share of inliers among the matched points of a newly registered image."""

    register_error_px: float = Field(default=6.0, gt=0.0)
    """Largest reprojection error of an inlier when an image is registered."""

    min_angle_deg: float = Field(default=1.0, ge=0.0, lt=90.0)
    """Smallest angle in degrees between the rays to a point of the model."""

    min_track_length: int = Field(default=3, ge=2)
    """Observations that a point needs to take part; 2 if only two images have a pose."""

    sparse_observations: int = Field(default=100, ge=0)
    """An image with fewer observations of such points also keeps its points seen in two images only."""

    min_observations: int = Field(default=10, ge=0)
    """Observations that an image needs to stay registered."""

    select_above_images: int = Field(default=500, ge=0)
    """Number of registered images above which the solver may work on a selection of the points."""

    early_observations: int = Field(default=300, ge=0)
    """Observations per image used in all passes but the last of models with more than select_above_images
    images, from the longest tracks; 0 uses all."""

    final_observations: int = Field(default=0, ge=0)
    """Observations per image used in the last pass alone of models with more than select_above_images
    images, which takes the most memory; 0 uses all. 1000 takes less memory and costs a little accuracy."""

    max_iterations: Annotated[int, Field(ge=1, le=1_000_000)] | Literal["auto"] = "auto"
    """Solver iterations per pass; 'auto' is 50, up to 500 in small models, where they are cheap."""

    function_tolerance: float = Field(default=3e-6, gt=0.0)
    """The last pass ends when the cost decreases by less than this, relatively; earlier passes end at
    300 times this."""

    @model_validator(mode="after")
    def _let_thresholds_fall(self) -> Self:
        if any(later > earlier for earlier, later in pairwise(self.thresholds_px)):
            raise ValueError("thresholds_px must not rise: no round may have a larger one than that before")
        return self

    @model_validator(mode="after")
    def _refine_in_ever_finer_images(self) -> Self:
        if any(finer <= coarser for coarser, finer in pairwise(self.refine_finenesses)):
            raise ValueError("refine_finenesses must increase: each resolution must exceed the one before")
        return self
