"""Rotations as (..., 3, 3) matrices, vectorised.

Exponential and logarithm are plain numpy because scipy.spatial takes longer to load than most jobs to run;
both are exact to rounding near 0 and near pi too.
"""

import numpy as np

from snakesfm.arrays import Array

IDENTITY = np.eye(3)
GENERATORS = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]],
    dtype=np.float64,
).reshape(3, 3, 3)
"""The matrices of the cross products with x, y and z."""


def exp_so3(vectors: Array) -> Array:
    """Rotation vectors (..., 3) in radians to matrices (..., 3, 3), by Rodrigues' formula."""
    vectors = np.asarray(vectors, dtype=np.float64)
    halves = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))[..., None, None] / 2.0
    sincs = np.divide(np.sin(halves), halves, out=np.ones_like(halves), where=halves > 0.0)
    cosines = np.cos(halves)
    skew = (vectors @ GENERATORS.reshape(3, 9)).reshape(*vectors.shape, 3)
    outer = vectors[..., :, None] * vectors[..., None, :]
    matrices: Array = (
        (2.0 * cosines**2 - 1.0) * IDENTITY + (sincs * cosines) * skew + (sincs**2 / 2.0) * outer
    )
    return matrices


def log_so3(rotations: Array) -> Array:
    """Matrices (..., 3, 3) to rotation vectors (..., 3) in radians, at most pi long."""
    quaternions = _quaternions(np.asarray(rotations, dtype=np.float64))
    vectors, w = quaternions[..., :3], quaternions[..., 3]
    vectors = np.where(w[..., None] < 0.0, -vectors, vectors)
    sines = np.linalg.norm(vectors, axis=-1)
    angles = 2.0 * np.arctan2(sines, np.abs(w))
    scales = np.divide(angles, sines, out=np.full_like(sines, 2.0), where=sines > 0.0)
    return np.asarray(vectors * scales[..., None])


def _quaternions(rotations: Array) -> Array:
    """Unit quaternions (..., 4) as x, y, z, w, of either sign (Markley, JGCD 2008)."""
    m = np.moveaxis(rotations, (-2, -1), (0, 1))
    xx, yy, zz = m[0, 0], m[1, 1], m[2, 2]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    xw, yw, zw = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    # 4 q q^T, of which the row with the largest diagonal element loses no digits
    rows = [
        [1.0 + xx - yy - zz, xy, xz, xw],
        [xy, 1.0 - xx + yy - zz, yz, yw],
        [xz, yz, 1.0 - xx - yy + zz, zw],
        [xw, yw, zw, 1.0 + xx + yy + zz],
    ]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))


def angle_of(rotations: Array) -> Array:
    """Angles (...,) in radians of matrices (..., 3, 3); exact for small angles too."""
    angles: Array = np.linalg.norm(log_so3(rotations), axis=-1)
    return angles


def angle_between(a: Array, b: Array) -> Array:
    """Angles (...,) in radians between vectors (..., 3), stable near 0 and pi."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    angles: Array = np.arctan2(cross, np.sum(a * b, axis=-1))
    return angles
