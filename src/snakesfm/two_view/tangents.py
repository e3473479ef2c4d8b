"""The five parameters of a relative pose: a left rotation increment and two tangents of the direction."""

import cv2
import numpy as np

from snakesfm.arrays import Array


def tangent_basis(translations: Array) -> Array:
    """Orthonormal bases (..., 3, 2) of the planes tangent to unit vectors (..., 3).

    The first column is ``t x e_k`` made unit, where ``e_k`` is the axis of t's smallest absolute component
    (the first of equals); the second column is ``t x first``. Covariances of directions are in this basis.
    """
    t = np.asarray(translations, dtype=np.float64)
    if t.ndim == 1:
        # np.cross costs more than all the rest for one vector
        skew = cross_matrix(t)
        first = skew[:, int(np.argmin(np.abs(t)))]
        first = first / np.sqrt(first @ first)
        return np.column_stack([first, skew @ first])
    axes = np.eye(3)[np.argmin(np.abs(t), axis=-1)]
    first = np.cross(t, axes)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(t, first)], axis=-1)


def perturb_pose(rotation: Array, translation: Array, step: Array) -> tuple[Array, Array]:
    """Apply an increment (5,) in radians to a relative pose.

    The rotation (3,3) becomes ``exp(step[:3]) rotation``; the unit translation (3,) moves by ``step[3:]``
    in its :func:`tangent_basis` and is made unit again.
    """
    moved = translation + tangent_basis(translation) @ step[3:]
    return cv2.Rodrigues(step[:3])[0] @ rotation, moved / np.linalg.norm(moved)


def cross_matrix(v: Array) -> Array:
    """The matrix (3,3) whose product with w is the cross product v x w."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
