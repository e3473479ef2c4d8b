"""Degenerate cases: a planar scene, and a camera that only rotates."""

import cv2
import numpy as np
import poselib

from snakesfm.arrays import Array
from snakesfm.geometry.robust import robust_sigma
from snakesfm.geometry.rotations import GENERATORS, exp_so3
from snakesfm.two_view.covariance import cauchy_variance, invert_information
from snakesfm.two_view.sampson import (
    Correspondences,
    cauchy_weights,
    solve_damped,
)


def _transfer_focal(points: Correspondences) -> float:
    """Pixels per unit of image j by which transfer errors are as noisy as between equal focal lengths.

    In pixels of image j, the noise of image i would be focal_j / focal_i times as large.
    """
    inverse_square = 0.5 * (points.focal_i**-2 + points.focal_j**-2)
    return float(inverse_square**-0.5)


def fit_homography(points: Correspondences, max_error_px: float, seed: int) -> tuple[Array, int]:
    """The homography (3,3) from rays i to rays j, and how many it explains.

    ``max_error_px`` bounds a transfer error weighed as in :func:`transfer_errors_px`.
    """
    if len(points) < 4:
        return np.eye(3), len(points)
    focal = _transfer_focal(points)
    H, info = poselib.estimate_homography(
        points.rays_i[:, :2] * focal,
        points.rays_j[:, :2] * focal,
        {
            "max_reproj_error": max_error_px,
            "min_iterations": 20,
            "max_iterations": 100,
            "dyn_num_trials_mult": 1.0,
            "seed": seed,
        },
        {},
    )
    scale = np.diag([focal, focal, 1.0])
    return np.linalg.solve(scale, H @ scale), int(np.sum(info["inliers"]))


def planar_twins(H: Array) -> list[tuple[Array, Array]]:
    """The relative poses (3,3), unit (3,) that one plane seen as the homography H (3,3) of rays allows.

    Source: Malis and Vargas, Deeper understanding of the homography decomposition, INRIA RR-6303, 2007.
    """
    if abs(np.linalg.det(H)) < 1e-12 or not np.isfinite(H).all():
        return []
    count, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    twins = []
    for row in range(count):
        length = float(np.linalg.norm(translations[row]))
        if np.isfinite(length) and length > 1e-6 and np.linalg.det(rotations[row]) > 0:
            twins.append((np.asarray(rotations[row]), np.asarray(translations[row]).ravel() / length))
    return twins


def transfer_errors_px(points: Correspondences, rotation: Array) -> Array:
    """Errors (M,2) in image j, in pixels, of the points of image i turned by ``rotation``.

    They are weighed by the noise of both images: with noise s in each, every coordinate has sqrt(2) s
    whatever the focal lengths, so that swapped images are judged alike.
    """
    turned = points.rays_i @ rotation.T
    depth = np.where(turned[:, 2] > 1e-6, turned[:, 2], np.nan)
    errors = _transfer_focal(points) * (turned[:, :2] / depth[:, None] - points.rays_j[:, :2])
    return np.nan_to_num(errors, nan=1e6)


def fit_rotation(points: Correspondences, rotation: Array, floor_px: float) -> tuple[Array, Array]:
    """The rotation (3,3) alone that explains the correspondences best, and its covariance (3,3) in rad^2.

    Gauss-Newton on the Cauchy loss of the transfer error, from a nearby rotation; the loss is scaled by
    the measured noise, which is not taken below ``floor_px``.
    """
    focal = _transfer_focal(points)
    for _ in range(10):
        turned = points.rays_i @ rotation.T
        inverse = 1.0 / np.maximum(turned[:, 2], 1e-6)
        image = turned[:, :2] * inverse[:, None]
        errors = focal * (image - points.rays_j[:, :2])
        scale = robust_sigma(errors.ravel(), floor_px)
        d_turned = np.stack([turned @ g.T for g in GENERATORS], axis=1)
        # (M,3,2) flattened to one row per coordinate
        jacobian = (
            focal * inverse[:, None, None] * (d_turned[:, :, :2] - image[:, None, :] * d_turned[:, :, 2:])
        )
        rows = jacobian.transpose(0, 2, 1).reshape(-1, 3)
        weighted = rows * np.repeat(cauchy_weights(np.linalg.norm(errors, axis=1), scale), 2)[:, None]
        step = solve_damped(weighted.T @ rows, weighted.T @ errors.ravel())
        rotation = exp_so3(step) @ rotation
        if np.linalg.norm(step) < 1e-8:
            break
    return rotation, invert_information(rows.T @ rows / cauchy_variance(errors, scale, 3))
