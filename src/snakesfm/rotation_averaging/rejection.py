"""Which edges do not fit averaged rotations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

SIGMAS = 5.0
RAYLEIGH3_MEDIAN = 1.5382
"""Median length of a vector of three standard normal components."""


def residual_limit(residuals: Array, smallest: float, largest: float) -> float:
    """Residual above which an edge is refused: five robust standard deviations, kept within bounds.

    Parameters
    ----------
    residuals : (E,), NaN where not compared, in the unit of the bounds.
    smallest, largest : bounds of the limit; ``largest`` wins.
    """
    known = residuals[np.isfinite(residuals)]
    sigma = np.median(known) / RAYLEIGH3_MEDIAN if len(known) else 0.0
    return float(min(max(SIGMAS * sigma, smallest), largest))
