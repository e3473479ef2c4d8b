"""Replacement of camera models that do not describe the lens by a more general one."""

from collections.abc import Collection

import numpy as np

from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.principal_points import shared_cameras
from snakesfm.bundle.reading import points_in_cameras, read_tracks_and_pixels
from snakesfm.bundle.selection import with_some_points
from snakesfm.bundle.trials import read_cameras, try_cameras
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.lens_fit import MAX_MISFIT, LensFit, fit_lenses

WIDER_MODEL = "OPENCV_FISHEYE"
"""It has four terms of the angle, so it describes perspective lenses with strong distortion, too."""
NOISE_SHARE = 0.5
"""Of the errors, what a wider model must leave at most: a better fit alone may be a bent model."""
RADII = 10
# more points tell no more of a lens, and cost time
MAX_POINTS = 10_000


def find_wider_lenses(
    reconstruction: pycolmap.Reconstruction,
    adjust: BundleAdjuster,
    solving: SolverSettings,
) -> dict[int, Camera]:
    """Cameras by id whose lens is not of their model, with a model and parameters that fit better.

    Parameters
    ----------
    reconstruction : an adjusted model with free distortion; stays as it is.
    adjust, solving : the solver; cameras that it holds, or of few images, are no candidates.
    """
    fits = _fits(reconstruction, shared_cameras(reconstruction, solving.constant_cameras))
    doubtful = {
        camera_id: _as_fisheye(reconstruction.camera(camera_id))
        for camera_id, fit in fits.items()
        if fit.misfit > MAX_MISFIT
    }
    if not doubtful:
        return {}
    some = with_some_points(reconstruction, MAX_POINTS)
    trial = try_cameras(some, doubtful, adjust, solving)
    before, after = _fits(some, doubtful), _fits(trial, doubtful)
    better = [k for k in after if k in before and after[k].noise_px < NOISE_SHARE * before[k].noise_px]
    return read_cameras(trial, better)


def _fits(reconstruction: pycolmap.Reconstruction, camera_ids: Collection[int]) -> dict[int, LensFit]:
    if not camera_ids:
        return {}
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    camera_of, in_camera = points_in_cameras(reconstruction, tracks)
    cameras = read_cameras(reconstruction, camera_ids)
    return fit_lenses(cameras, camera_of, tracks.images, in_camera, pixels)


def _as_fisheye(camera: pycolmap.Camera) -> Camera:
    """A fisheye camera without distortion whose rays are near those of a camera, over the image's width."""
    focals, center = camera.focal_length_idxs(), camera.principal_point_idxs()
    x, y = (float(camera.params[k]) for k in center)
    radii = np.linspace(0.05, 0.5, RADII) * max(camera.width, camera.height)
    rays = np.asarray(camera.cam_from_img(np.column_stack([x + radii, np.full(RADII, y)])))
    angles = np.arctan(np.linalg.norm(rays, axis=1))
    usable = np.isfinite(angles) & (angles > 0)
    focal = float(camera.params[focals[0]])
    if usable.any():
        focal = float((radii * angles)[usable].sum() / np.square(angles[usable]).sum())
    return Camera(WIDER_MODEL, camera.width, camera.height, (focal, focal, x, y, 0.0, 0.0, 0.0, 0.0))
