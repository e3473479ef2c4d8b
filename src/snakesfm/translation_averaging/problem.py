"""The input of translation averagers."""

from dataclasses import dataclass, replace

import numpy as np

from snakesfm.arrays import Array


@dataclass(frozen=True)
class PositioningProblem:
    """Directions in the world frame between N cameras, and from cameras to T landmarks.

    Rows of tracks are sorted by track, then image. Everything is finite: images without rotation have
    neither edges nor rays.
    """

    image_count: int
    """N."""
    pairs: Array
    """(E,2) int64, images i and j of each edge."""
    directions: Array
    """(E,3) unit vector from camera i to camera j."""
    sigmas_rad: Array
    """(E) standard deviation of the direction."""
    ray_images: Array
    """(Q) int64, image of each ray."""
    ray_tracks: Array
    """(Q) int64, track of each ray, ascending; tracks need not all occur."""
    rays: Array
    """(Q,3) unit vector from the camera to the landmark."""

    def select_rays(self, rows: Array) -> "PositioningProblem":
        """The same problem with some of the rays; ``rows`` is a mask or ascending indices."""
        return PositioningProblem(
            self.image_count,
            self.pairs,
            self.directions,
            self.sigmas_rad,
            self.ray_images[rows],
            self.ray_tracks[rows],
            self.rays[rows],
        )

    def select_edges(self, rows: Array) -> "PositioningProblem":
        """The same problem with some of the edges."""
        return PositioningProblem(
            self.image_count,
            self.pairs[rows],
            self.directions[rows],
            self.sigmas_rad[rows],
            self.ray_images,
            self.ray_tracks,
            self.rays,
        )

    def select_images(self, images: Array) -> "PositioningProblem":
        """The same problem with the rays of some images (N,) bool and the edges between them."""
        inside = np.asarray(images[self.pairs].all(axis=1))
        return self.select_edges(inside).select_rays(images[self.ray_images])

    def number_tracks(self) -> tuple["PositioningProblem", Array]:
        """The same problem with the tracks that occur numbered from 0, and the former number of each."""
        tracks, rows = np.unique(self.ray_tracks, return_inverse=True)
        return replace(self, ray_tracks=rows), tracks

    def images(self) -> Array:
        """Ascending ids of the images that occur."""
        return np.unique(np.concatenate([self.pairs.ravel(), self.ray_images]))


def edge_directions(rotations: Array, pairs: Array, translations: Array) -> Array:
    """Unit vectors (E,3) in the world from camera i to camera j.

    Parameters
    ----------
    rotations : (N,3,3) cam_from_world.
    pairs : (E,2).
    translations : (E,3) j_from_i translations.
    """
    return np.asarray(-np.einsum("eji,ej->ei", rotations[pairs[:, 1]], translations))


def world_rays(rotations: Array, image_ids: Array, normalized: Array) -> Array:
    """Unit vectors (Q,3) in the world of undistorted points (Q,2) on the plane z = 1 of their cameras."""
    rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
    rays = np.einsum("qji,qj->qi", rotations[image_ids], rays)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def direction_sigmas(covariances: Array) -> Array:
    """Standard deviations (E) in radians of the translations' directions; 5 degrees where unknown.

    Parameters
    ----------
    covariances : (E,5,5) rad^2, rows 3 and 4 of the direction's tangents; NaN where unknown.
    """
    variances = (covariances[:, 3, 3] + covariances[:, 4, 4]) / 2.0
    known = np.isfinite(variances) & (variances > 0)
    return np.where(known, np.sqrt(np.where(known, variances, 1.0)), np.radians(5.0))
