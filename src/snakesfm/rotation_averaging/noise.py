"""A noise model of the relative rotations of a graph, fitted to their residuals."""

import itertools

import numpy as np

from snakesfm.arrays import Array

DEGREES_OF_FREEDOM = 4.0
"""Of the Student t distribution of the residuals."""

FLOORS = (0.001, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)
"""Isotropic noise that is tried on top of the given covariances, in units of their median variance."""

SMALLEST_RAD = np.radians(0.01)


def fit_noise(residuals: Array, given: Array) -> Array:
    """Scale covariances, on top of an isotropic floor, so that the residuals are most likely.

    Two-view covariances know nothing of wrong intrinsics or mismatches and are often too small. Several
    floors are tried; with the largest one all edges weigh the same. Covariances whose axes the residuals do
    not bear out, as of surfaces seen from one side, are made isotropic.

    Parameters
    ----------
    residuals : (E,3) radians.
    given : (E,3,3) covariances up to a common factor.

    Returns
    -------
    (E,3,3) rad^2.
    """
    means = np.trace(given, axis1=1, axis2=2) / 3.0
    unit = float(np.median(means))
    best, best_likelihood = given, -np.inf
    for shape, floor in itertools.product((given, means[:, None, None] * np.eye(3)), FLOORS):
        shaped = shape / unit + floor * np.eye(3)
        squares = squared_lengths(residuals, np.linalg.inv(shaped))
        scale = _scale(squares)
        tails = (DEGREES_OF_FREEDOM + 3.0) * np.log1p(squares / scale / DEGREES_OF_FREEDOM)
        likelihood = -0.5 * float(np.sum(np.linalg.slogdet(shaped * scale)[1] + tails))
        if likelihood > best_likelihood:
            best, best_likelihood = shaped * scale, likelihood
    return best


def fill_covariances(covariances: Array, weights: Array) -> Array:
    """Covariances (E,3,3) whose unknown ones are isotropic and inverse to the ``weights`` (E,).

    They are at the level of the known ones of the same weight; up to a common factor if none is known.
    """
    traces = np.trace(covariances, axis1=1, axis2=2)
    known = np.isfinite(covariances).all(axis=(1, 2)) & (traces > 0)
    level = float(np.median(traces[known] * weights[known])) / 3.0 if known.any() else 1.0
    return np.where(known[:, None, None], covariances, level * np.eye(3) / weights[:, None, None])


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
