"""The oracle ``virtual``: keypoints projected from a known model instead of detected in the image."""

from typing import Any

import numpy as np

from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.virtual_points import ObservedPoints, PointSource, SurfacePoints, ViewPoints
from snakesfm.geometry.colmap_binding import pycolmap

# of a ray's x and y at depth 1: far above rounding and far below a pixel
RAY_TOLERANCE = 1e-5


class VirtualKeypoints:
    """Where the points of a known model project in its images: an oracle without noise or false matches.

    A point is seen by the images that the model says observe it. The descriptor of a keypoint is the number
    of its point, so the matcher ``virtual`` pairs equal ones. What a back-end makes of these shows its own
    errors alone (Baid et al. 2023, "Distributed Global Structure-from-Motion with a Deep Front-End", arXiv
    2311.18801).

    With ``surface_points`` the points lie evenly on a surface through the model's points instead, and an
    image sees those that the surface does not hide; with ``view_points`` they are spread over each image's
    view, and nothing hides them: for models whose own points are few.

    Parameters
    ----------
    model : COLMAP model; with points, unless ``view_points`` are asked for.
    surface_points : how many points lie on the surface; 0 for none.
    view_points : how many points each image's view gets; 0 for none.

    Raises
    ------
    ConfigError : the model has no points and ``view_points`` is 0, or there is no open3d for a surface.
    """

    descriptor_size = 4
    descriptor_dtype: Any = np.uint8
    usual_keypoints = 100_000

    def __init__(
        self, model: pycolmap.Reconstruction, surface_points: int = 0, view_points: int = 0
    ) -> None:
        if not model.points3D and not view_points:
            raise ConfigError(
                "The reference model has no points, which the front-end 'virtual' needs: set reference= to "
                "a model with points, set extract_features.view_points to 300 for points at random depths, "
                "or use another front_end."
            )
        self._images = {image.name: image for image in model.images.values()}
        self._cameras = model.cameras
        self._points: PointSource
        if surface_points:
            self._points = SurfacePoints(model, surface_points)
        elif view_points:
            self._points = ViewPoints(model, view_points)
        else:
            self._points = ObservedPoints(model)

    def read(self, name: str, size: tuple[int, int]) -> KeypointSet:
        """See :class:`snakesfm.features.keypoints.KeypointSource`; an image without a pose has none."""
        image = self._images.get(name)
        if image is None or not image.has_pose:
            return KeypointSet.empty(self.descriptor_size, self.descriptor_dtype)
        camera = self._cameras[image.camera_id]
        ids, points, scores = self._points.seen_by(image)
        local = image.cam_from_world() * points
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
            scores[inside],
            np.ones(count, np.float32),
            np.zeros(count, np.float32),
            size,
        )
