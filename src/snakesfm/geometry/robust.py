"""Statistics that withstand wrong values."""

import numpy as np

from snakesfm.arrays import Array

MAD_TO_SIGMA = 1.4826


def robust_sigma(errors: Array, floor: float) -> float:
    """Standard deviation of errors (n,) by their median absolute value, and no less than ``floor``."""
    if len(errors) == 0:
        return floor
    return max(MAD_TO_SIGMA * float(np.median(np.abs(errors))), floor)
