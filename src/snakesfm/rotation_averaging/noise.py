"""How far the relative rotations of a graph can be trusted: a noise model fitted to their residuals."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

DEGREES_OF_FREEDOM = 4.0
"""Of the Student t distribution of the residuals."""

FLOORS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)
"""Isotropic noise that is tried on top of the given covariances, in units of their median variance."""

SMALLEST_RAD = np.radians(0.01)


def fit_noise(residuals: Array, candidates: list[Array]) -> tuple[Array, float]:
    """Choose and scale covariances so that the residuals are most likely.

    Two-view covariances know nothing of wrong intrinsics or mismatches and are often too small. Every
    candidate is tried with several isotropic floors, and scaled; with the largest floor all edges weigh the
    same.

    Parameters
    ----------
    residuals : (E,3) radians.
    candidates : covariances (E,3,3), each up to one common factor.

    Returns
    -------
    covariances : (E,3,3) rad^2.
    likelihood : log-likelihood of the residuals under them.
    """
    best: tuple[Array, float] | None = None
    for candidate in candidates:
        unit = float(np.median(np.trace(candidate, axis1=1, axis2=2))) / 3.0
        for floor in FLOORS:
            shaped = candidate / unit + floor * np.eye(3)
            squares = squared_lengths(residuals, np.linalg.inv(shaped))
            scale = _scale(squares)
            likelihood = float(
                np.sum(
                    -0.5 * np.linalg.slogdet(shaped * scale)[1]
                    - 0.5 * (DEGREES_OF_FREEDOM + 3.0) * np.log1p(squares / scale / DEGREES_OF_FREEDOM)
                )
            )
            if best is None or likelihood > best[1]:
                best = shaped * scale, likelihood
    if best is None:
        raise ValueError("no candidate covariances")
    return best


def squared_lengths(residuals: Array, information: Array) -> Array:
    """Squared Mahalanobis lengths (E,) of residuals (E,3) under information matrices (E,3,3)."""
    lengths: Array = np.einsum("ea,eab,eb->e", residuals, information, residuals)
    return lengths


def student_weights(squares: Array) -> Array:
    """Weights (E,) of squared Mahalanobis lengths in the maximum likelihood estimate."""
    weights: Array = (DEGREES_OF_FREEDOM + 3.0) / (DEGREES_OF_FREEDOM + squares)
    return weights


def _scale(squares: Array) -> float:
    """Variance factor of Student t residuals, by expectation maximisation."""
    smallest = float(SMALLEST_RAD) ** 2
    scale = max(float(np.median(squares)) / 2.366, smallest)
    for _ in range(20):
        scale = max(float(np.mean(student_weights(squares / scale) * squares)) / 3.0, smallest)
    return scale
