"""Trials of other cameras on some points of a model."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.reading import points_in_cameras, read_tracks_and_pixels
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import rows_of_each


def read_cameras(reconstruction: pycolmap.Reconstruction, camera_ids: Collection[int]) -> dict[int, Camera]:
    """Cameras of a model by their ids."""
    return {camera_id: Camera.of_pycolmap(reconstruction.camera(camera_id)) for camera_id in camera_ids}


def set_cameras(reconstruction: pycolmap.Reconstruction, cameras: Mapping[int, Camera]) -> None:
    """Give cameras, by their ids, another model and parameters."""
    for camera_id, camera in cameras.items():
        target = reconstruction.camera(camera_id)
        target.model = getattr(pycolmap.CameraModelId, camera.model)
        target.params = list(camera.params)


def try_cameras(
    reconstruction: pycolmap.Reconstruction,
    cameras: Mapping[int, Camera],
    adjust: BundleAdjuster,
    solving: SolverSettings,
) -> pycolmap.Reconstruction:
    """A copy of a model that was adjusted with some cameras, by their ids, replaced."""
    trial = pycolmap.Reconstruction(reconstruction)
    set_cameras(trial, cameras)
    adjust(trial, solving)
    return trial


def error_shares(
    before: pycolmap.Reconstruction,
    after: pycolmap.Reconstruction,
    average: Callable[[Array], Any] = np.median,
) -> dict[int, float]:
    """Of the median reprojection error of each camera that has observations, by its id, what is left.

    Parameters
    ----------
    before, after : models of the same points and observations; the cameras are those of the first.
    average : what is taken instead of the median, of observations whose points the camera sees before;
        errors after are infinite where it no longer does.
    """
    (camera_of, errors), (_, left) = _errors(before), _errors(after)
    seen = {camera_id: mine[np.isfinite(errors[mine])] for camera_id, mine in rows_of_each(camera_of)}
    return {
        camera_id: float(average(left[mine]) / max(average(errors[mine]), 1e-9)) if len(mine) else np.inf
        for camera_id, mine in seen.items()
    }


def _errors(reconstruction: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Id of the camera (L,) int64 of each observation, and its reprojection error (L,) in pixels.

    It is infinite where the camera does not see the point, as of one that came to lie behind it.
    """
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    camera_of, in_camera = points_in_cameras(reconstruction, tracks)
    errors = np.zeros(len(camera_of))
    for camera_id, mine in rows_of_each(camera_of):
        seen = reconstruction.camera(camera_id).img_from_cam(in_camera[mine])
        errors[mine] = np.linalg.norm(seen - pixels[mine], axis=1)
    return camera_of, np.where(np.isnan(errors), np.inf, errors)
