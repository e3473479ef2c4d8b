"""Rigid poses as arrays, the way to pycolmap's, and similarities between worlds."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.orientations import MIRRORED_Y, SWAPPED

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class Similarity:
    """reference_from_model: x_reference = scale * rotation @ x_model + translation."""

    scale: float
    rotation: Array
    translation: Array

    def transform_points(self, points: Array) -> Array:
        """Points (..., 3) of the model in the reference's world and units."""
        return self.scale * points @ self.rotation.T + self.translation

    def transform_rotations(self, rotations: Array) -> Array:
        """cam_from_world rotations (..., 3, 3) of the model as cam_from_reference."""
        return rotations @ self.rotation.T


def has_pose(rotations: Array, translations: Array) -> Array:
    """Which (...) bool of cam_from_world poses (...,3,3) and (...,3) are known; NaN marks the others."""
    turned = np.isfinite(rotations).all(axis=(-2, -1))
    return np.asarray(turned & np.isfinite(translations).all(axis=-1))


def center_of(rotations: Array, translations: Array) -> Array:
    """Camera centres (..., 3) in the world of cam_from_world poses: -R^T t."""
    centers: Array = -np.einsum("...ji,...j->...i", rotations, translations)
    return centers


def translation_of(rotations: Array, centers: Array) -> Array:
    """cam_from_world translations (..., 3) from rotations and camera centres: -R c."""
    translations: Array = -np.einsum("...ij,...j->...i", rotations, centers)
    return translations


def to_camera(rotations: Array, translations: Array, points: Array) -> Array:
    """World points (..., 3) in the frames of cam_from_world poses: R X + t."""
    in_camera: Array = np.einsum("...ij,...j->...i", rotations, points) + translations
    return in_camera


def to_rigid3d(rotation: Array, translation: Array) -> "pycolmap.Rigid3d":
    """One pose for pycolmap."""
    from snakesfm.geometry.colmap_binding import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(rotation)), np.asarray(translation))


def lower_sides(rotations: Array, orientations: Array) -> Array:
    """Directions in the world (N,3) of the lower sides of photographs.

    Parameters
    ----------
    rotations : (N,3,3) cam_from_world, NaN where not registered.
    orientations : (N,) EXIF orientations 1..8, which tell the lower side of the pixels as stored.
    """
    axes = np.where(np.isin(orientations, SWAPPED), 0, 1)
    signs = np.where(np.isin(orientations, MIRRORED_Y), -1.0, 1.0)
    lower: Array = signs[:, None] * rotations[np.arange(len(rotations)), axes]
    return lower
