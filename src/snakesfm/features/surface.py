"""Points on a surface through a model's points, and the images that see them, by open3d."""

import importlib
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ConfigError


class Surface:
    """The alpha shape of points (Edelsbrunner and Muecke 1994), with points spread evenly over it.

    Of the radii from the median distance of a point to its nearest neighbour upwards, each twice the last,
    the one is taken that has most points on the surface.

    Parameters
    ----------
    points : (P,3) float64, at least four.
    count : points N that are spread.
    seed : of their places.

    Raises
    ------
    ConfigError : open3d cannot be loaded, or the points span no surface.
    """

    def __init__(self, points: Array, count: int, seed: int) -> None:
        self._open3d = _load_open3d()
        vertices, triangles = self._alpha_shape(points)
        corners = vertices[triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(cross, axis=1)
        rng = np.random.default_rng(seed)
        self.triangle_ids = rng.choice(len(triangles), count, p=areas / areas.sum())
        weights = rng.dirichlet((1, 1, 1), count)
        self.points = np.einsum("nk,nkd->nd", weights, corners[self.triangle_ids])
        self._scene = self._open3d.t.geometry.RaycastingScene(nthreads=1)
        tensor = self._open3d.core.Tensor
        self._scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))

    def _alpha_shape(self, points: Array) -> tuple[Array, Array]:
        geometry, utility = self._open3d.geometry, self._open3d.utility
        cloud = geometry.PointCloud(utility.Vector3dVector(points))
        radius = float(np.median(np.asarray(cloud.compute_nearest_neighbor_distance())))
        extent = float(np.linalg.norm(np.ptp(points, axis=0)))
        most, best = 0, None
        with utility.VerbosityContextManager(utility.VerbosityLevel.Error):
            whole = geometry.TetraMesh.create_from_point_cloud(cloud)
            while 0 < radius < 2 * extent:
                mesh = geometry.TriangleMesh.create_from_point_cloud_alpha_shape(cloud, radius, *whole)
                corners = len(np.unique(np.asarray(mesh.triangles)))
                if corners > most:
                    most, best = corners, mesh
                radius *= 2
        if best is None:
            raise ConfigError(
                "The reference model's points span no surface: set extract_features.surface_points to 0."
            )
        return np.asarray(best.vertices), np.asarray(best.triangles)

    def seen_from(self, center: Array) -> Array:
        """Which points (N,) bool are not hidden by the surface from a camera centre (3,)."""
        rays = np.concatenate([np.broadcast_to(center, self.points.shape), self.points - center], axis=1)
        hit = self._scene.cast_rays(self._open3d.core.Tensor(rays.astype(np.float32)), nthreads=1)
        # a point is seen where the first triangle on its ray is its own
        return np.asarray(hit["primitive_ids"].numpy() == self.triangle_ids)


def _load_open3d() -> Any:
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        raise ConfigError(
            f"extract_features.surface_points needs open3d, which cannot be loaded ({error}): run "
            "'pip install -c constraints.txt .[surface]' in snakesfm's folder, or set surface_points to 0."
        ) from None
