"""Global descriptors whose similarities do not depend on how a product of matrices sums them."""

import numpy as np

from snakesfm.arrays import Array

STEPS = 2048.0


def round_units(vectors: Array) -> Array:
    """Vectors (...) float64 of unit length, or zeros, rounded to multiples of 1/2048, as float32.

    Their dot products in float32 are exact, whatever the order of the sums: all of these are multiples of
    2^-22 and below 2, as rounding lengthens a vector of D numbers by at most sqrt(D)/4096.
    """
    rounded: Array = (np.rint(vectors * STEPS) / STEPS).astype(np.float32)
    return rounded
