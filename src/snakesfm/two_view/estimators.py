"""Robust estimators of the relative pose: one interface, several libraries."""

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
import poselib

from snakesfm.arrays import Array
from snakesfm.two_view.sampson import Correspondences

MINIMAL_SAMPLE = 5
CONFIDENCE = 0.9999


@dataclass(frozen=True)
class RobustPose:
    """A relative pose (3,3) and unit (3,), j_from_i, and which correspondences (M,) bool support it."""

    rotation: Array
    translation: Array
    inliers: Array


class PoseEstimator(Protocol):
    """Estimates a relative pose from correspondences with outliers; the same seed gives the same result.

    The correspondences come best first: an estimator may draw from the first ones sooner.
    """

    def __call__(
        self, points: Correspondences, max_error_px: float, max_iterations: int, seed: int
    ) -> RobustPose | None:
        """The pose with the most support, or None where there is none.

        Parameters
        ----------
        points : M correspondences, best first.
        max_error_px : largest epipolar error of a correspondence that supports a pose, in pixels of the
            mean focal length: the Sampson error in PoseLib and COLMAP, the library's own in OpenCV.
        max_iterations : most hypotheses that are tried.
        seed : the only source of randomness.
        """
        ...


def _robust_pose(rotation: Array, translation: Array, inliers: Array) -> RobustPose | None:
    length = float(np.linalg.norm(translation))
    if not np.isfinite(length) or length < 1e-12 or not np.isfinite(rotation).all():
        return None
    inliers = np.asarray(inliers, dtype=bool).ravel()
    if inliers.sum() < MINIMAL_SAMPLE:
        return None
    return RobustPose(np.asarray(rotation), np.asarray(translation) / length, inliers)


def poselib_camera(focal_px: float) -> dict[str, Any]:
    """A camera for points that are already undistorted and centred."""
    return {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal_px, 0.0, 0.0]}


def estimate_poselib(
    points: Correspondences, max_error_px: float, max_iterations: int, seed: int
) -> RobustPose | None:
    """LO-MSAC with a five-point solver, progressive sampling and refinement of the Sampson error (PoseLib).

    Source: Chum and Matas, Matching with PROSAC, CVPR 2005.
    """
    if len(points) < MINIMAL_SAMPLE:
        return None
    focal = points.mean_focal
    camera = poselib_camera(focal)
    pose, info = poselib.estimate_relative_pose(
        points.rays_i[:, :2] * focal,
        points.rays_j[:, :2] * focal,
        camera,
        camera,
        {
            "max_epipolar_error": max_error_px,
            "min_iterations": min(20, max_iterations),
            "max_iterations": max_iterations,
            "dyn_num_trials_mult": 1.0,
            "success_prob": CONFIDENCE,
            "progressive_sampling": True,
            "seed": seed,
        },
        {"loss_type": "CAUCHY", "loss_scale": 0.5 * max_error_px},
    )
    return _robust_pose(pose.R, pose.t, np.array(info["inliers"], dtype=bool))


def estimate_opencv_gcransac(
    points: Correspondences, max_error_px: float, max_iterations: int, seed: int
) -> RobustPose | None:
    """Graph-cut RANSAC of OpenCV's USAC (``USAC_ACCURATE``), the estimator of GTSfM.

    Source: Barath and Matas, Graph-Cut RANSAC, CVPR 2018.
    """
    if len(points) < MINIMAL_SAMPLE + 1:
        return None
    # USAC draws from a fixed state: the seed enters by the order of the points
    order = np.random.default_rng(seed).permutation(len(points))
    points_i = np.ascontiguousarray(points.rays_i[order, :2])
    points_j = np.ascontiguousarray(points.rays_j[order, :2])
    identity = np.eye(3)
    try:
        E, mask = cv2.findEssentialMat(
            points_i,
            points_j,
            identity,
            method=cv2.USAC_ACCURATE,
            prob=CONFIDENCE,
            threshold=max_error_px / points.mean_focal,
            maxIters=max_iterations,
        )
    except cv2.error:
        return None
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    found = mask.ravel().astype(bool)
    if found.sum() < MINIMAL_SAMPLE:
        return None
    _, rotation, translation, _ = cv2.recoverPose(E, points_i[found], points_j[found], identity)
    inliers = np.zeros(len(points), dtype=bool)
    inliers[order] = found
    return _robust_pose(rotation, translation.ravel(), inliers)


def estimate_pycolmap(
    points: Correspondences, max_error_px: float, max_iterations: int, seed: int
) -> RobustPose | None:
    """LO-RANSAC of COLMAP.

    Source: Chum, Matas and Kittler, Locally optimized RANSAC, DAGM 2003.
    """
    if len(points) < MINIMAL_SAMPLE:
        return None
    focal = points.mean_focal
    from snakesfm.geometry.colmap_binding import pycolmap

    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0.0, 0.0])
    options = pycolmap.RANSACOptions()
    options.max_error = max_error_px
    options.confidence = CONFIDENCE
    options.min_num_trials = min(100, max_iterations)
    options.max_num_trials = max_iterations
    options.random_seed = seed
    result = pycolmap.estimate_essential_matrix(
        points.rays_i[:, :2] * focal, points.rays_j[:, :2] * focal, camera, camera, options
    )
    if result is None:
        return None
    pose = result["cam2_from_cam1"]
    return _robust_pose(pose.rotation.matrix(), pose.translation, np.asarray(result["inlier_mask"]))


ESTIMATORS: dict[str, PoseEstimator] = {
    "poselib": estimate_poselib,
    "opencv_gcransac": estimate_opencv_gcransac,
    "pycolmap": estimate_pycolmap,
}
