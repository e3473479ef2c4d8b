"""The pose of one image from its matches to points of the model, and its focal length if unknown."""

import copy
from dataclasses import dataclass

import numpy as np
import poselib

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.poses import to_rigid3d

MINIMAL_SAMPLE = 4
# one more unknown has to explain this many times the matches to be believed
FOCAL_GAIN = 1.2
# of other models poselib returns the identity with all matches as inliers
POSELIB_MODELS = frozenset(
    {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"}
)


@dataclass(frozen=True)
class Resection:
    """A pose cam_from_world, the intrinsics it goes with, and which matches (M,) bool agree with both."""

    pose: pycolmap.Rigid3d
    camera: pycolmap.Camera
    inliers: Array

    @property
    def support(self) -> int:
        """How many matches agree."""
        return int(np.count_nonzero(self.inliers))


def resect(
    camera: pycolmap.Camera,
    pixels: Array,
    points: Array,
    max_error_px: float,
    max_focal_px: float,
    seed: int,
) -> Resection:
    """Estimate the pose of an image, and its focal length where the camera's does not explain the matches.

    Parameters
    ----------
    camera : the intrinsics, not changed.
    pixels, points : (M,2) keypoints and (M,3) points of the world that they may see.
    max_error_px : largest reprojection error of an inlier.
    max_focal_px : longest focal length that may take the place of the camera's; 0 keeps the camera's.
        What is longer is cut to this.
    seed : of the robust estimators.
    """
    known = _with_camera(camera, pixels, points, max_error_px, seed)
    if max_focal_px == 0 or len(pixels) < MINIMAL_SAMPLE:
        return known
    free = _with_free_focal(camera, pixels, points, max_error_px, max_focal_px, seed)
    return free if free is not None and free.support > FOCAL_GAIN * known.support else known


def _with_camera(
    camera: pycolmap.Camera, pixels: Array, points: Array, max_error_px: float, seed: int
) -> Resection:
    """LO-RANSAC over P3P with a final refinement, by poselib where it knows the camera's model."""
    if camera.model_name not in POSELIB_MODELS:
        found = _by_colmap(camera, pixels, points, max_error_px, seed, free_focal=False)
        return found or Resection(pycolmap.Rigid3d(), camera, np.zeros(len(pixels), dtype=bool))
    description = {
        "model": camera.model_name,
        "width": camera.width,
        "height": camera.height,
        "params": list(camera.params),
    }
    pose, info = poselib.estimate_absolute_pose(
        pixels,
        points,
        description,
        {"max_reproj_error": max_error_px, "seed": seed},
        {"loss_type": "CAUCHY", "loss_scale": 1.0},
    )
    return Resection(to_rigid3d(pose.R, pose.t), camera, np.asarray(info["inliers"], dtype=bool))


def _with_free_focal(
    camera: pycolmap.Camera,
    pixels: Array,
    points: Array,
    max_error_px: float,
    max_focal_px: float,
    seed: int,
) -> Resection | None:
    """LO-RANSAC over P4Pf with a final refinement of the focal length too, by COLMAP."""
    found = _by_colmap(camera, pixels, points, max_error_px, seed, free_focal=True)
    if found is None:
        return None
    free = found.camera
    if free.mean_focal_length() > max_focal_px:
        # so long a lens sees nearly parallel rays, which a somewhat shorter one nearly explains
        params = np.array(free.params)
        params[list(free.focal_length_idxs())] = max_focal_px
        free.params = params
        return _with_camera(free, pixels, points, max_error_px, seed)
    return found


def _by_colmap(
    camera: pycolmap.Camera, pixels: Array, points: Array, max_error_px: float, seed: int, free_focal: bool
) -> Resection | None:
    """LO-RANSAC of COLMAP, which knows all of its models, with a copy of the camera."""
    used = copy.copy(camera)
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = free_focal
    estimation.ransac.max_error = max_error_px
    estimation.ransac.random_seed = seed
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.refine_focal_length = free_focal
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, used, estimation, refinement)
    if found is None:
        return None
    seen = found["cam_from_world"] * points
    errors = np.linalg.norm(used.img_from_cam(seen) - pixels, axis=1)
    inliers = (seen[:, 2] > 0) & (errors < max_error_px)
    return Resection(found["cam_from_world"], used, inliers)
