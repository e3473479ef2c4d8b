"""VLAD: one vector per image from its local descriptors (Jegou et al. 2010)."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.retrieval.codebook import nearest_words, sum_by_word
from snakesfm.retrieval.rounding import round_units


def describe_vlad(descriptors: Array, centers: Array, power: float) -> Array:
    """Sum up the residuals of an image's descriptors to their nearest words.

    Each word's sum is scaled to unit length (intra-normalisation, Arandjelovic and Zisserman 2013), then
    the entries are raised to ``power`` with their sign kept (Jegou et al. 2012) and the whole is scaled to
    unit length.

    Parameters
    ----------
    descriptors : (N,D), any real dtype.
    centers : (W,D) float32.
    power : exponent in (0, 1].

    Returns
    -------
    (W*D,) float32 of unit length up to rounding to multiples of 1/2048, or zeros without descriptors:
    such an image resembles none.
    """
    if len(descriptors) == 0 or len(centers) == 0:
        return np.zeros(centers.size, np.float32)
    sums, counts = sum_by_word(descriptors, nearest_words(descriptors, centers), len(centers))
    residuals = sums - counts[:, None] * centers
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-12)
    vector = np.sign(residuals) * np.abs(residuals) ** power
    vector /= max(float(np.linalg.norm(vector)), 1e-12)
    return round_units(vector.ravel())
