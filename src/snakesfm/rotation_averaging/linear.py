"""The linear step that all iterative averagers share: increments from weighted edge residuals."""

from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import exp_so3, log_so3
from snakesfm.geometry.sparse_systems import solve_spd
from snakesfm.grouping import sum_by

DIRECT_DEGREE = 30
"""Mean degree up to which the sparse factor is small; denser graphs converge fast without one."""

DENSE_SIZE = 1000
"""Unknowns up to which a system of a denser graph is factored as a full matrix."""


def world_residuals(pairs: Array, rotations: Array, averaged: Array) -> Array:
    """Residuals (E,3) in radians, log(R_j^T R_ij R_i), in the world's frame."""
    return log_so3(averaged[pairs[:, 1]].transpose(0, 2, 1) @ rotations @ averaged[pairs[:, 0]])


def apply_increments(averaged: Array, increments: Array) -> Array:
    """Rotations (N,3,3) moved by increments (N,3) in the world's frame."""
    moved: Array = averaged @ exp_so3(increments)
    return moved


def solve_isotropic(node_count: int, pairs: Array, weights: Array, residuals: Array) -> Array:
    """Increments x (N,3) that minimise sum w |x_j - x_i - r|^2, with x_0 = 0.

    Parameters
    ----------
    weights : (E,) > 0.
    residuals : (E,3) in radians.
    """
    from scipy.sparse import coo_array

    heads, tails = pairs[:, 0], pairs[:, 1]
    rows = np.concatenate([heads, tails, heads, tails])
    columns = np.concatenate([heads, tails, tails, heads])
    values = np.concatenate([weights, weights, -weights, -weights])
    laplacian = coo_array((values, (rows, columns)), shape=(node_count, node_count)).tocsc()
    weighted = weights[:, None] * residuals
    right = sum_by(weighted, tails, node_count) - sum_by(weighted, heads, node_count)
    increments = np.zeros((node_count, 3))
    increments[1:] = _solve(laplacian[1:, 1:], right[1:], 2.0 * len(pairs) / node_count)
    return increments


def solve_anisotropic(node_count: int, pairs: Array, information: Array, residuals: Array) -> Array:
    """Increments x (N,3) that minimise sum (x_j - x_i - r)^T W (x_j - x_i - r), with x_0 = 0.

    Parameters
    ----------
    information : (E,3,3) symmetric positive definite, in the world's frame.
    residuals : (E,3) in radians.
    """
    from scipy.sparse import coo_array

    heads, tails = pairs[:, 0], pairs[:, 1]
    axes = np.arange(3)
    rows = np.concatenate([heads, tails, heads, tails])[:, None, None] * 3 + axes[:, None]
    columns = np.concatenate([heads, tails, tails, heads])[:, None, None] * 3 + axes[None, :]
    values = np.concatenate([information, information, -information, -information])
    rows, columns = np.broadcast_to(rows, values.shape), np.broadcast_to(columns, values.shape)
    size = 3 * node_count
    hessian = coo_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsc()
    weighted = np.einsum("eab,eb->ea", information, residuals)
    right = sum_by(weighted, tails, node_count) - sum_by(weighted, heads, node_count)
    increments = np.zeros(size)
    solved = _solve(hessian[3:, 3:], right.ravel()[3:, None], 2.0 * len(pairs) / node_count, block=3)
    increments[3:] = solved[:, 0]
    return increments.reshape(node_count, 3)


def _solve(matrix: Any, right: Array, mean_degree: float, block: int = 1) -> Array:
    """Solution (n,k) of a graph's symmetric positive definite system."""
    from scipy.linalg import cho_factor, cho_solve

    if mean_degree <= DIRECT_DEGREE:
        return solve_spd(matrix, right, block)
    if matrix.shape[0] <= DENSE_SIZE:
        return np.asarray(cho_solve(cho_factor(matrix.toarray(), overwrite_a=True), right))
    return solve_spd(matrix, right, factored_up_to=DENSE_SIZE, tolerance=1e-6, iterations=2000)
