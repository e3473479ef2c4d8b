"""Camera intrinsics in COLMAP's models."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.poses import to_camera
from snakesfm.grouping import rows_of_each

if TYPE_CHECKING:
    import pycolmap

PARAM_SLOTS = 16
ROUND_TRIP_PX = 1.0
WIDE_MODELS = frozenset({"FOV", "EUCM", "SIMPLE_DIVISION", "DIVISION"})
"""Without FISHEYE in their names, and still of lenses that may see 90 degrees off their axis and more."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Parameters
    ----------
    model : COLMAP camera model name, such as ``PINHOLE`` or ``SIMPLE_RADIAL``.
    width, height : image size in pixels.
    params : COLMAP's parameters in pixels, in COLMAP's order.
    source : where the focal length comes from: given, exif, estimated, default.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    source: str = "given"

    def to_pycolmap(self, camera_id: int = 1) -> "pycolmap.Camera":
        """The same camera for pycolmap."""
        from snakesfm.geometry.colmap_binding import pycolmap

        return pycolmap.Camera(
            camera_id=camera_id,
            model=self.model,
            width=self.width,
            height=self.height,
            params=list(self.params),
        )

    @classmethod
    def of_pycolmap(cls, camera: "pycolmap.Camera", source: str = "given") -> "Camera":
        """The camera that pycolmap holds."""
        params = tuple(float(value) for value in camera.params)
        return cls(camera.model_name, camera.width, camera.height, params, source)

    def normalize(self, keypoints: Array) -> Array:
        """Pixels (N,2) to undistorted points (N,2) on the plane z = 1 of the camera frame, NaN if none."""
        if len(keypoints) == 0:
            return np.zeros((0, 2))
        camera, pixels = self.to_pycolmap(), np.asarray(keypoints, dtype=np.float64)
        points = np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2)
        if self.is_fisheye:
            # of angles beyond 90 degrees, which no plane holds, COLMAP gives some point of it
            again = np.asarray(camera.img_from_cam(np.column_stack([points, np.ones(len(points))])))
            points[~(np.linalg.norm(again.reshape(-1, 2) - pixels, axis=1) < ROUND_TRIP_PX)] = np.nan
        return points

    @property
    def is_fisheye(self) -> bool:
        """Whether the model is one of lenses that may see 90 degrees off their axis and more."""
        return "FISHEYE" in self.model or self.model in WIDE_MODELS

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return float(self.to_pycolmap().mean_focal_length())

    def with_focal(self, focal_px: float, source: str) -> "Camera":
        """The same camera with another mean focal length in pixels."""
        camera = self.to_pycolmap()
        scale = focal_px / camera.mean_focal_length()
        params = np.array(camera.params)
        params[camera.focal_length_idxs()] *= scale
        return replace(self, params=tuple(params.tolist()), source=source)

    def scaled(self, factor: float, size: tuple[int, int] | None = None) -> "Camera":
        """The same camera in pixels of another size: ``factor`` of the new ones are one of the old.

        Parameters
        ----------
        size : width and height in the new pixels; by default the old ones times ``factor``, rounded.
        """
        if factor == 1.0:
            return self
        camera = self.to_pycolmap()
        params = np.array(camera.params)
        # distortion counts on the plane z = 1, in all of COLMAP's models
        params[[*camera.focal_length_idxs(), *camera.principal_point_idxs()]] *= factor
        width, height = size or (round(self.width * factor), round(self.height * factor))
        return replace(self, width=width, height=height, params=tuple(params.tolist()))


def cameras_to_columns(cameras: Sequence[Camera]) -> tuple[list[str], Array, Array, list[str]]:
    """Cameras as columns of an artifact: models, sizes (C,2), params (C,16), sources."""
    params = np.full((len(cameras), PARAM_SLOTS), np.nan)
    for row, camera in enumerate(cameras):
        params[row, : len(camera.params)] = camera.params
    sizes = np.array([(c.width, c.height) for c in cameras], dtype=np.int32).reshape(-1, 2)
    return [c.model for c in cameras], sizes, params, [c.source for c in cameras]


def cameras_from_columns(
    models: Array, sizes: Array, params: Array, sources: Array | None = None
) -> list[Camera]:
    """Inverse of :func:`cameras_to_columns`."""
    return [
        Camera(
            str(models[row]),
            int(sizes[row, 0]),
            int(sizes[row, 1]),
            tuple(params[row][~np.isnan(params[row])].tolist()),
            "given" if sources is None else str(sources[row]),
        )
        for row in range(len(models))
    ]


def undistort(cameras: Sequence[Camera], camera_ids: Array, image_ids: Array, keypoints: Array) -> Array:
    """Points (L,2) on the plane z = 1 of pixels (L,2) of several images."""
    rays = np.full((len(image_ids), 2), np.nan)
    for camera, rows in rows_of_each(camera_ids[image_ids]):
        rays[rows] = cameras[camera].normalize(keypoints[rows])
    return rays


def observation_errors(
    cameras: Sequence[Camera],
    camera_ids: Array,
    rotations: Array,
    translations: Array,
    points: Array,
    image_ids: Array,
    keypoints: Array,
) -> Array:
    """Reprojection errors (L,) in pixels of observations; inf behind the camera.

    Parameters
    ----------
    cameras, camera_ids : intrinsics, and which of them each image (N,) has.
    rotations, translations : (N,3,3) and (N,3), cam_from_world.
    points : (L,3) the observed point of each observation, in the world.
    image_ids, keypoints : (L,), (L,2) observations.
    """
    errors = np.full(len(image_ids), np.inf)
    for image, rows in rows_of_each(image_ids):
        in_camera = to_camera(rotations[image], translations[image], points[rows])
        ahead = in_camera[:, 2] > 0
        rows, camera = rows[ahead], cameras[camera_ids[image]].to_pycolmap()
        projected = np.asarray(camera.img_from_cam(in_camera[ahead])).reshape(-1, 2)
        errors[rows] = np.linalg.norm(projected - keypoints[rows], axis=1)
    return errors
