"""Covariance of a refined relative pose from the derivatives of its residuals."""

import numpy as np

from snakesfm.arrays import Array

DIRECTION_UNKNOWN_VARIANCE = float(np.pi**2 / 3.0)


def invert_information(information: Array) -> Array:
    """Inverse (P,P) of an information matrix whose weak directions get a large, finite variance."""
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    inverse = 1.0 / np.maximum(values, 1.0 / DIRECTION_UNKNOWN_VARIANCE)
    covariance: Array = (vectors * inverse) @ vectors.T
    return covariance


def cauchy_variance(errors: Array, scale: float, parameters: int) -> float:
    """The factor that makes (J^T J)^-1 the covariance of an estimate by the Cauchy loss.

    Parameters
    ----------
    errors : (M,) residuals, or (M,D) residual vectors whose length the loss takes.

    Source: Huber, Robust Statistics, section 7.6: sum(psi^2) / (M - P) / mean(psi')^2, of all coordinates.
    """
    vectors = errors.reshape(len(errors), -1)
    u = np.sum((vectors / scale) ** 2, axis=1)
    weights = 1.0 / (1.0 + u)
    slope = weights - 2.0 / vectors.shape[1] * u * weights**2
    spread = float(np.sum((vectors * weights[:, None]) ** 2)) / max(vectors.size - parameters, 1)
    return spread / max(float(np.mean(slope)), 0.1) ** 2


def pose_covariance(jacobian: Array, errors: Array, scale: float) -> Array:
    """Covariance (5,5) in rad^2 of a relative pose.

    Parameters
    ----------
    jacobian, errors : (M,5) and (M,), residuals in pixels at the solution, of its inliers.
    scale : scale of the Cauchy loss in pixels that the solution minimises.
    """
    variance = cauchy_variance(errors, scale, jacobian.shape[1])
    return invert_information(jacobian.T @ jacobian / max(variance, 1e-12))
