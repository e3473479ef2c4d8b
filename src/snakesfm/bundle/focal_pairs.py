"""Cameras with two focal lengths whose images determine only one of them.

Where all cameras stand upright at one height, as around an object or along a street, the vertical focal
length trades with the height of the world: nothing in the images tells the two apart. Most pixels are
square, so two focal lengths that come out different are a sign of it, if one does as well. Where pixels are
not, as of anamorphic video or images stretched to a size, the images tell, also cameras that began with one
focal length.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.principal_points import shared_cameras
from snakesfm.bundle.selection import with_some_points
from snakesfm.bundle.trials import error_shares, read_cameras, try_cameras
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap

ONE_FOCAL_MODELS = {
    "PINHOLE": "SIMPLE_PINHOLE",
    "OPENCV": "RADIAL",
    "FULL_OPENCV": "RADIAL",
    "OPENCV_FISHEYE": "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE": "RADIAL_FISHEYE",
}
"""Of each model of two focal lengths the one with one and the same first terms of distortion."""
MAX_SKEW = 0.02
"""Difference of two focal lengths that is taken for real; calibrated lenses stay within a tenth of it."""
SQUARE = 1e-6
MAX_ERROR_RATIO = 1.05
"""Of mean reprojection errors with one focal length and with two, where one does as well."""
STRETCHED_ERROR_RATIO = 1.25
"""The same, where pixels are surely not square: more freedom also fits what else is wrong better."""
STRETCHED_MODELS = {"SIMPLE_RADIAL": "OPENCV"}
"""Of models of one focal length what shows pixels that are not square."""
# more points tell no more of two numbers, and cost time
MAX_POINTS = 2500


def find_stretched_cameras(
    reconstruction: pycolmap.Reconstruction, adjust: BundleAdjuster, solving: SolverSettings
) -> dict[int, Camera]:
    """Cameras of one focal length by id whose pixels are not square, with a model and parameters of two.

    One focal length bends the model so that its errors hardly show what is wrong: two are tried, on some of
    the points, and taken where they come apart and the camera's images are not explained as well by one.

    Parameters
    ----------
    reconstruction : an adjusted model with free distortion; stays as it is.
    adjust, solving : the solver; cameras that it holds, or of few images, are no candidates.
    """
    shared = sorted(shared_cameras(reconstruction, solving.constant_cameras))
    wider = {
        k: with_two_focals(camera, STRETCHED_MODELS[camera.model])
        for k, camera in read_cameras(reconstruction, shared).items()
        if camera.model in STRETCHED_MODELS
    }
    if not wider:
        return {}
    trial = try_cameras(with_some_points(reconstruction, MAX_POINTS), wider, adjust, solving)
    found = {k: camera for k, camera in read_cameras(trial, wider).items() if _skew(camera) > MAX_SKEW}
    square = find_square_cameras(trial, found, adjust, solving, STRETCHED_ERROR_RATIO)
    return {k: camera for k, camera in found.items() if k not in square}


def skewed_cameras(reconstruction: pycolmap.Reconstruction, cameras: Sequence[Camera]) -> list[int]:
    """Ids of cameras whose focal lengths were one and came apart.

    Parameters
    ----------
    reconstruction : an adjusted model.
    cameras : the intrinsics before any adjustment.
    """
    return [
        row + 1
        for row, start in enumerate(cameras)
        if start.model in ONE_FOCAL_MODELS
        and _skew(start) < SQUARE
        and _skew(Camera.of_pycolmap(reconstruction.camera(row + 1))) > MAX_SKEW
    ]


def find_square_cameras(
    reconstruction: pycolmap.Reconstruction,
    camera_ids: Collection[int],
    adjust: BundleAdjuster,
    solving: SolverSettings,
    max_error_ratio: float = MAX_ERROR_RATIO,
) -> dict[int, Camera]:
    """Those cameras by id that explain their images about as well with one focal length, so changed.

    Parameters
    ----------
    reconstruction : an adjusted model; stays as it is.
    camera_ids : of cameras of two focal lengths.
    adjust, solving : the solver.
    max_error_ratio : of mean reprojection errors with one focal length and with two, what is as well.
    """
    if not camera_ids:
        return {}
    square = {k: with_one_focal(camera) for k, camera in read_cameras(reconstruction, camera_ids).items()}
    trial = try_cameras(reconstruction, square, adjust, solving)
    # the solver gives up what does not fit, so the median would hardly show it
    shares = error_shares(reconstruction, trial, np.mean)
    # a camera whose images are gone has none
    return {k: camera for k, camera in square.items() if shares.get(k, 0.0) <= max_error_ratio}


def _skew(camera: Camera) -> float:
    return abs(camera.params[1] / camera.params[0] - 1.0)


def with_one_focal(camera: Camera) -> Camera:
    """A camera of two focal lengths with the horizontal one alone, and its radial terms."""
    model = ONE_FOCAL_MODELS[camera.model]
    f, _, cx, cy, *terms = camera.params
    return replace(camera, model=model, params=(f, cx, cy, *terms[: _term_count(model)]))


def with_equal_focals(camera: Camera) -> Camera:
    """A camera of two focal lengths with the horizontal one twice."""
    return replace(camera, params=(camera.params[0], camera.params[0], *camera.params[2:]))


def with_two_focals(camera: Camera, model: str) -> Camera:
    """A camera of one focal length as one of two, whose other terms are zero."""
    f, cx, cy, *terms = camera.params
    zeros = [0.0] * (_term_count(model) - len(terms))
    return replace(camera, model=model, params=(f, f, cx, cy, *terms, *zeros))


def _term_count(model: str) -> int:
    """How many terms of distortion a camera model has."""
    return len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).extra_params_idxs())
