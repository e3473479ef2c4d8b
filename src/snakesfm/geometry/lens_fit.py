"""Test of whether a camera model describes the distortion of the lens."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.robust import robust_sigma
from snakesfm.grouping import rows_of_each

MAX_MISFIT = 0.2
"""Models that fit have 0.01 to 0.13."""
ANNULI = 10
MIN_OBSERVATIONS = 500
# fewer never tell a lens from the tilt of their poses
MIN_IMAGES = 5
# of exact keypoints no error is left but that of the solver
LEAST_NOISE_PX = 0.01


@dataclass(frozen=True)
class LensFit:
    """How well a camera's model describes its lens.

    Parameters
    ----------
    misfit : how much of the reprojection errors follows the distance from the principal point, 0 where the
        distortion is the lens's: the root mean square over ten annuli, of as many observations each, of the
        median error along the radius, in ``noise_px``.
    noise_px : robust standard deviation of the errors across the radius.
    """

    misfit: float
    noise_px: float


def fit_lenses(
    cameras: Mapping[int, Camera], camera_of: Array, images: Array, in_camera: Array, keypoints: Array
) -> dict[int, LensFit]:
    """How well the models of cameras describe their lenses, by the cameras' numbers.

    Parameters
    ----------
    cameras : those that are asked for, by any number.
    camera_of : (L,) these numbers of the observations.
    images : (L,) image of each observation; cameras with fewer than five are left out, as are those with
        fewer than 500 observations.
    in_camera : (L,3) observed points in the frames of their images' cameras.
    keypoints : (L,2) pixels of the observations.
    """
    fits = {}
    for number, rows in rows_of_each(camera_of):
        if (
            number in cameras
            and len(rows) >= MIN_OBSERVATIONS
            and len(np.unique(images[rows])) >= MIN_IMAGES
        ):
            fits[number] = _fit(cameras[number], in_camera[rows], keypoints[rows])
    return fits


def _fit(camera: Camera, in_camera: Array, keypoints: Array) -> LensFit:
    model = camera.to_pycolmap()
    errors = keypoints - np.asarray(model.img_from_cam(in_camera))
    # what the model cannot show
    finite = np.isfinite(errors).all(axis=1)
    errors, keypoints = errors[finite], keypoints[finite]
    offsets = keypoints - [model.params[k] for k in model.principal_point_idxs()]
    radii = np.linalg.norm(offsets, axis=1)
    outward = offsets / np.maximum(radii, 1e-9)[:, None]
    along = (errors * outward).sum(axis=1)
    across = errors[:, 1] * outward[:, 0] - errors[:, 0] * outward[:, 1]
    noise_px = robust_sigma(across, LEAST_NOISE_PX)
    medians = [np.median(part) for part in np.array_split(along[np.argsort(radii)], ANNULI)]
    return LensFit(float(np.sqrt(np.mean(np.square(medians)))) / noise_px, noise_px)
