"""The oracle ``virtual``: keypoints that are known of an image instead of found in it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.geometry.colmap_binding import pycolmap

Array = NDArray[Any]


class VirtualKeypoints:
    """Where the points of a known model project in its images: an oracle without noise or false matches.

    A point is seen by the images that the model says observe it. The descriptor of a keypoint is the number
    of its point, so the matcher ``virtual`` pairs equal ones. What a back-end makes of these shows its own
    errors alone (Li et al. 2026, "Distributed Global Structure-from-Motion with a Deep Front-End").

    Parameters
    ----------
    model : COLMAP model with points.

    Raises
    ------
    ConfigError : the model has no points.
    """

    descriptor_size = 4
    descriptor_dtype: Any = np.uint8
    usual_keypoints = 100_000

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        if not model.points3D:
            raise ConfigError(
                "The reference model has no points, which the front-end 'virtual' needs: "
                "give reference=PATH of a model with points, or take another front_end."
            )
        self._images = {image.name: image for image in model.images.values()}
        self._cameras = model.cameras
        self._points = model.points3D

    def read(self, name: str, size: tuple[int, int]) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.KeypointSource`; an image without a pose has none."""
        image = self._images.get(name)
        if image is None or not image.has_pose:
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        ids = np.unique([point.point3D_id for point in image.points2D if point.has_point3D()]).astype(
            np.uint32
        )
        pose, camera = image.cam_from_world(), self._cameras[image.camera_id]
        points = np.array([self._points[number].xyz for number in ids.tolist()]).reshape(-1, 3)
        local = points @ pose.rotation.matrix().T + pose.translation
        scale = np.array(size) / [camera.width, camera.height]
        ahead = local[:, 2] > 0
        places = np.full((len(ids), 2), -1.0)
        places[ahead] = camera.img_from_cam(local[ahead]) * scale
        inside = ahead & (places > 0).all(axis=1) & (places < size).all(axis=1)
        lengths = np.array([self._points[number].track.length() for number in ids.tolist()], np.float32)
        count = int(inside.sum())
        return KeypointSet(
            places[inside].astype(np.float32),
            ids[inside].astype("<u4").view(np.uint8).reshape(-1, 4),
            lengths[inside],
            np.ones(count, np.float32),
            np.zeros(count, np.float32),
            size,
        )
