"""Which points the oracle ``virtual`` knows, and which of them an image sees."""

from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial import cKDTree

from snakesfm.arrays import Array
from snakesfm.features.surface import Surface
from snakesfm.geometry.colmap_binding import pycolmap

# of a point where an image observes none, times the distance to the nearest other camera
DEPTHS = (2.0, 50.0)


class SeenPoints(NamedTuple):
    """What an image sees: numbers (N,) uint32, places (N,3) float64 in the world, scores (N,) float32."""

    ids: Array
    places: Array
    scores: Array


class PointSource(Protocol):
    """Points of the world with numbers that are the same in all images."""

    def seen_by(self, image: pycolmap.Image) -> SeenPoints:
        """The points that a model's image with a pose may see; those that do not project into it too."""
        ...


class ObservedPoints:
    """A model's own points, each seen by the images that observe it; scores are the tracks' lengths."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self._points = model.points3D

    def seen_by(self, image: pycolmap.Image) -> SeenPoints:
        """See :class:`PointSource`."""
        ids = np.unique([point.point3D_id for point in image.points2D if point.has_point3D()])
        points = [self._points[number] for number in ids.tolist()]
        return SeenPoints(
            ids.astype(np.uint32),
            np.array([point.xyz for point in points]).reshape(-1, 3),
            np.array([point.track.length() for point in points], np.float32),
        )


class SurfacePoints:
    """Points spread evenly over a surface through a model's points; an image sees those it does not hide.

    Parameters
    ----------
    model : COLMAP model with points.
    count : points on the surface.

    Raises
    ------
    ConfigError : there is no open3d, or the points span no surface.
    """

    def __init__(self, model: pycolmap.Reconstruction, count: int) -> None:
        points = np.array([model.points3D[number].xyz for number in sorted(model.points3D)])
        self._surface = Surface(points, count, seed=0)

    def seen_by(self, image: pycolmap.Image) -> SeenPoints:
        """See :class:`PointSource`."""
        seen = self._surface.seen_from(image.projection_center())
        ids = np.flatnonzero(seen).astype(np.uint32)
        return SeenPoints(ids, self._surface.points[ids], np.ones(len(ids), np.float32))


class ViewPoints:
    """Points spread over each image's view; nothing hides them.

    A point lies on the ray of a random pixel, as deep as the observed point that is nearest in the image,
    and every image may see it. So overlapping images share points however few the model itself has there.
    Where an image observes none, depths are random, ``DEPTHS`` times the distance to the nearest camera.

    Parameters
    ----------
    model : COLMAP model with poses; it may have no points.
    count : points per image.
    """

    def __init__(self, model: pycolmap.Reconstruction, count: int) -> None:
        observed = ObservedPoints(model)
        rng = np.random.default_rng(0)
        images = [model.images[number] for number in sorted(model.images) if model.images[number].has_pose]
        centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
        spread = [_spread(image, observed.seen_by(image).places, centers, count, rng) for image in images]
        # an image that sees too many keeps the lowest numbers, which must not all be of the same views
        self._points = rng.permutation(np.concatenate([np.zeros((0, 3)), *spread]))

    def seen_by(self, image: pycolmap.Image) -> SeenPoints:
        """See :class:`PointSource`."""
        count = len(self._points)
        return SeenPoints(np.arange(count, dtype=np.uint32), self._points, np.ones(count, np.float32))


def _spread(
    image: pycolmap.Image, observed: Array, centers: Array, count: int, rng: np.random.Generator
) -> Array:
    """Places (N,3) in the world of up to ``count`` points over an image's view.

    Parameters
    ----------
    image : with a pose.
    observed : (K,3) places of the points that it observes.
    centers : (I,3) of all cameras.
    """
    camera, pose = image.camera, image.cam_from_world()
    pixels = rng.uniform(0, [camera.width, camera.height], (count, 2))
    local = pose * observed
    local = local[local[:, 2] > 0]
    places = camera.img_from_cam(local)
    shown = np.isfinite(places).all(axis=1)
    if shown.any():
        depths = local[shown][cKDTree(places[shown]).query(pixels)[1], 2]
    else:
        apart = np.linalg.norm(centers - image.projection_center(), axis=1)
        low, high = DEPTHS
        depths = low * (high / low) ** rng.uniform(size=count) * apart[apart > 0].min(initial=np.inf)
    points = np.column_stack([camera.cam_from_img(pixels), np.ones(count)]) * depths[:, None]
    return np.asarray(pose.inverse() * points[np.isfinite(points).all(axis=1)])
