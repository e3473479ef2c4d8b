"""Rejection of edges that do not fit the averaged rotations."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.rotation_averaging.base import RotationGraph, edge_residuals

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


def contradiction(graph: RotationGraph, averaged: Array, scale_rad: float) -> float:
    """How many inlier matches contradict rotations (N,3,3), softly counted about ``scale_rad``.

    Unlike the cost that is descended, which takes the roots of the weights, this compares whole
    solutions: edges of repeated structure agree with each other, so that their number says little, but
    have fewer matches.
    Edges at a node without rotation count in full.
    """
    angles = edge_residuals(graph.pairs, graph.rotations, averaged)
    squares = np.where(np.isnan(angles), np.inf, angles) ** 2 / scale_rad**2
    return float(np.sum(graph.weights * (1.0 - 1.0 / (1.0 + squares))))
