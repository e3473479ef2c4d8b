"""Rigid poses as arrays, and the way to pycolmap's."""

from typing import Any

import cv2  # noqa: F401 - must be loaded before pycolmap, whose PNG library clashes otherwise
import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[Any]


def center_of(rotations: Array, translations: Array) -> Array:
    """Camera centres (..., 3) in the world of cam_from_world poses: -R^T t."""
    centers: Array = -np.einsum("...ji,...j->...i", rotations, translations)
    return centers


def translation_of(rotations: Array, centers: Array) -> Array:
    """cam_from_world translations (..., 3) from rotations and camera centres: -R c."""
    translations: Array = -np.einsum("...ij,...j->...i", rotations, centers)
    return translations


def to_rigid3d(rotation: Array, translation: Array) -> pycolmap.Rigid3d:
    """One pose for pycolmap."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.asarray(rotation)), np.asarray(translation))
