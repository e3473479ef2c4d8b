"""Errors against the truth."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.evaluation.alignment import median_rotation
from snakesfm.geometry.rotations import angle_of

Array = NDArray[Any]


def rotation_errors_deg(averaged: Array, truth: Array) -> Array:
    """Angles (K,) to the truth of the K images that have both, aligned by the median rotation."""
    known = np.isfinite(averaged[:, 0, 0]) & np.isfinite(truth[:, 0, 0])
    gauge = averaged[known].transpose(0, 2, 1) @ truth[known]
    return np.degrees(angle_of(gauge @ median_rotation(gauge).T))
