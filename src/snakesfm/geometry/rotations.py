"""Rotations as (..., 3, 3) matrices, vectorised.

scipy is imported where it is needed: it is a third of the start-up of stages that only compare directions.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def exp_so3(vectors: Array) -> Array:
    """Rotation vectors (..., 3) in radians to matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    vectors = np.asarray(vectors, dtype=np.float64)
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vectors.shape[:-1], 3, 3)


def log_so3(rotations: Array) -> Array:
    """Matrices (..., 3, 3) to rotation vectors (..., 3) in radians."""
    from scipy.spatial.transform import Rotation

    rotations = np.asarray(rotations, dtype=np.float64)
    flat = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(*rotations.shape[:-2], 3)


def angle_of(rotations: Array) -> Array:
    """Angles (...,) in radians of matrices (..., 3, 3); exact for small angles too."""
    angles: Array = np.linalg.norm(log_so3(rotations), axis=-1)
    return angles


def angle_between(a: Array, b: Array) -> Array:
    """Angles (...,) in radians between vectors (..., 3), stable near 0 and pi."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    angles: Array = np.arctan2(cross, np.sum(a * b, axis=-1))
    return angles
