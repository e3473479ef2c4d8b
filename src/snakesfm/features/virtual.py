"""The oracle ``virtual``: keypoints that are known of an image instead of found in it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.surface import Surface
from snakesfm.geometry.colmap_binding import pycolmap

Array = NDArray[Any]

# of a ray's x and y at depth 1: far above rounding and far below a pixel
RAY_TOLERANCE = 1e-5


class VirtualKeypoints:
    """Where the points of a known model project in its images: an oracle without noise or false matches.

    A point is seen by the images that the model says observe it. The descriptor of a keypoint is the number
    of its point, so the matcher ``virtual`` pairs equal ones. What a back-end makes of these shows its own
    errors alone (Li et al. 2026, "Distributed Global Structure-from-Motion with a Deep Front-End").

    With ``surface_points`` the points lie evenly on a surface through the model's points instead, and an
    image sees those that the surface does not hide: many more, where a model's own points are few.

    Parameters
    ----------
    model : COLMAP model with points.
    surface_points : how many points lie on the surface; 0 for the model's own points.

    Raises
    ------
    ConfigError : the model has no points, or there is no open3d for a surface.
    """

    descriptor_size = 4
    descriptor_dtype: Any = np.uint8
    usual_keypoints = 100_000

    def __init__(self, model: pycolmap.Reconstruction, surface_points: int = 0) -> None:
        if not model.points3D:
            raise ConfigError(
                "The reference model has no points, which the front-end 'virtual' needs: "
                "give reference=PATH of a model with points, or take another front_end."
            )
        self._images = {image.name: image for image in model.images.values()}
        self._cameras = model.cameras
        self._points = model.points3D
        self._surface = None
        if surface_points:
            points = np.array([model.points3D[number].xyz for number in sorted(model.points3D)])
            self._surface = Surface(points, surface_points, seed=0)

    def read(self, name: str, size: tuple[int, int]) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.KeypointSource`; an image without a pose has none."""
        image = self._images.get(name)
        if image is None or not image.has_pose:
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        pose, camera = image.cam_from_world(), self._cameras[image.camera_id]
        ids, points, lengths = self._seen(image, pose)
        local = points @ pose.rotation.matrix().T + pose.translation
        scale = np.array(size) / [camera.width, camera.height]
        ahead = local[:, 2] > 0
        places = np.full((len(ids), 2), -1.0)
        places[ahead] = camera.img_from_cam(local[ahead]) * scale
        inside = ahead & (places > 0).all(axis=1) & (places < size).all(axis=1)
        # distortion folds rays from far outside into the image: their pixels belong to other rays
        rays = camera.cam_from_img(places[inside] / scale)
        same = np.abs(rays - local[inside, :2] / local[inside, 2:]).max(axis=1, initial=0) < RAY_TOLERANCE
        inside[inside] = same
        count = int(inside.sum())
        return KeypointSet(
            places[inside].astype(np.float32),
            ids[inside].astype("<u4").view(np.uint8).reshape(-1, 4),
            lengths[inside],
            np.ones(count, np.float32),
            np.zeros(count, np.float32),
            size,
        )

    def _seen(self, image: pycolmap.Image, pose: pycolmap.Rigid3d) -> tuple[Array, Array, Array]:
        """Numbers (N,) uint32, places (N,3) and track lengths (N,) float32 of what an image sees."""
        if self._surface is not None:
            center = -pose.rotation.matrix().T @ pose.translation
            ids = np.flatnonzero(self._surface.seen_from(center)).astype(np.uint32)
            return ids, self._surface.points[ids], np.ones(len(ids), np.float32)
        numbers = [point.point3D_id for point in image.points2D if point.has_point3D()]
        ids = np.unique(numbers).astype(np.uint32)
        points = np.array([self._points[number].xyz for number in ids.tolist()]).reshape(-1, 3)
        lengths = np.array([self._points[number].track.length() for number in ids.tolist()], np.float32)
        return ids, points, lengths
