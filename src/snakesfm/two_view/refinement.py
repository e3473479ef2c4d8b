"""Refinement of a robustly estimated relative pose, with its covariance and its noise."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import poselib

from snakesfm.arrays import Array
from snakesfm.geometry.robust import robust_sigma
from snakesfm.two_view.bundle import refine_bundle
from snakesfm.two_view.covariance import pose_covariance
from snakesfm.two_view.estimators import poselib_camera
from snakesfm.two_view.sampson import (
    Correspondences,
    refine_sampson,
    sampson_errors_px,
    sampson_jacobian,
)

Refinement = Literal["none", "sampson", "bundle"]
SIGMA_FLOOR_PX = 0.03
NEAR_SIGMAS = 6.0


@dataclass(frozen=True)
class RefinedPose:
    """A relative pose, how certain it is and how noisy its matches are.

    Parameters
    ----------
    rotation, translation : (3,3) and unit (3,), j_from_i.
    covariance : (5,5) in rad^2, in the parameters of ``tangents.perturb_pose``.
    errors_px : (M,) signed Sampson errors of all correspondences.
    sigma_px : robust standard deviation of the inliers' errors.
    """

    rotation: Array
    translation: Array
    covariance: Array
    errors_px: Array
    sigma_px: float


def noise_px(errors: Array, reach_px: float) -> float:
    """Robust standard deviation of the errors (M,) that lie within ``reach_px``."""
    near = np.abs(errors) < reach_px
    return robust_sigma(errors[near], SIGMA_FLOOR_PX)


def refine_pose(
    points: Correspondences,
    rotation: Array,
    translation: Array,
    method: Refinement,
    reach_px: float,
    loss_scale: float,
) -> RefinedPose:
    """Refine a relative pose on the correspondences near it.

    Parameters
    ----------
    points : all correspondences, outliers included.
    method : ``none`` keeps the pose and only adds covariance and noise.
    reach_px : Sampson error up to which correspondences tell the noise.
    loss_scale : scale of the Cauchy loss in multiples of the measured noise.

    The noise is measured and the pose refined twice, for a better pose shows less noise.
    """
    errors = sampson_errors_px(points, rotation, translation)
    sigma = noise_px(errors, reach_px)
    if method != "none":
        for first in (True, False):
            near = points.take(np.abs(errors) < max(NEAR_SIGMAS * sigma, SIGMA_FLOOR_PX))
            rotation, translation = _refine(near, rotation, translation, method, loss_scale * sigma, first)
            errors = sampson_errors_px(points, rotation, translation)
            sigma = noise_px(errors, reach_px)
    near = points.take(np.abs(errors) < NEAR_SIGMAS * sigma)
    near_errors, jacobian = sampson_jacobian(near, rotation, translation)
    covariance = pose_covariance(jacobian, near_errors, max(loss_scale, 1.0) * sigma)
    return RefinedPose(rotation, translation, covariance, errors, sigma)


def _refine(
    points: Correspondences,
    rotation: Array,
    translation: Array,
    method: Refinement,
    scale_px: float,
    far: bool,
) -> tuple[Array, Array]:
    if len(points) < 6:
        return rotation, translation
    if method == "bundle":
        return refine_bundle(points, rotation, translation, scale_px, 10)
    # PoseLib weighs both images alike, refine_sampson each by its focal length
    if far or points.focal_i == points.focal_j:
        return descend_sampson(points, rotation, translation, scale_px)
    return refine_sampson(points, rotation, translation, scale_px, 5)


def descend_sampson(
    points: Correspondences, rotation: Array, translation: Array, scale_px: float
) -> tuple[Array, Array]:
    """The pose (3,3), unit (3,) of least Cauchy loss of the Sampson error near another, by PoseLib.

    Parameters
    ----------
    scale_px : scale of the loss in pixels of the mean focal length.
    """
    focal = points.mean_focal
    return descend_from(
        (rotation, translation), points.rays_i[:, :2] * focal, points.rays_j[:, :2] * focal, focal, scale_px
    )


def descend_from(
    pose: tuple[Array, Array], points_i: Array, points_j: Array, focal_px: float, scale_px: float
) -> tuple[Array, Array]:
    """The same for undistorted points (M,2) in pixels of one focal length, from the principal point."""
    camera, start = poselib_camera(focal_px), poselib.CameraPose()
    start.R, start.t = pose
    settings = {"loss_type": "CAUCHY", "loss_scale": scale_px, "max_iterations": 20}
    found, _ = poselib.refine_relative_pose(points_i, points_j, start, camera, camera, settings)
    length = float(np.linalg.norm(found.t))
    if not np.isfinite(length) or length < 1e-12:
        return pose
    return np.asarray(found.R), np.asarray(found.t) / length
