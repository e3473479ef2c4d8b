"""The Sampson error in pixels, its derivatives, and robust refinement of a relative pose on it."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import GENERATORS
from snakesfm.two_view.tangents import cross_matrix, perturb_pose, tangent_basis


@dataclass(frozen=True)
class Correspondences:
    """Matched points of two views, undistorted.

    Parameters
    ----------
    rays_i, rays_j : (M,3) float64, points on the plane z = 1 of each camera's frame.
    focal_i, focal_j : pixels per unit of that plane: the noise of a point is 1 / focal per pixel.
    """

    rays_i: Array
    rays_j: Array
    focal_i: float
    focal_j: float

    def __len__(self) -> int:
        return len(self.rays_i)

    def take(self, rows: Array) -> "Correspondences":
        """The correspondences of a mask or of row numbers."""
        return Correspondences(self.rays_i[rows], self.rays_j[rows], self.focal_i, self.focal_j)

    @property
    def mean_focal(self) -> float:
        """Pixels per unit for methods that know one scale only."""
        return 0.5 * (self.focal_i + self.focal_j)


def essential_matrix(rotation: Array, translation: Array) -> Array:
    """E = [t]x R (3,3), so that ray_j^T E ray_i = 0."""
    return cross_matrix(translation) @ rotation


def sampson_errors_px(points: Correspondences, rotation: Array, translation: Array) -> Array:
    """Signed Sampson errors (M,) in pixels, each image weighted by its own focal length."""
    E = essential_matrix(rotation, translation)
    lines_j = points.rays_i @ E.T
    lines_i = points.rays_j @ E
    algebraic = np.einsum("nk,nk->n", points.rays_j, lines_j)
    variance = _line_variance(points, lines_i, lines_j)
    errors: Array = algebraic / np.sqrt(np.maximum(variance, 1e-300))
    return errors


def _line_variance(points: Correspondences, lines_i: Array, lines_j: Array) -> Array:
    square_i = lines_i[:, 0] ** 2 + lines_i[:, 1] ** 2
    square_j = lines_j[:, 0] ** 2 + lines_j[:, 1] ** 2
    variance: Array = square_i / points.focal_i**2 + square_j / points.focal_j**2
    return variance


def sampson_jacobian(points: Correspondences, rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Sampson errors (M,) in pixels and their derivatives (M,5) by the parameters of ``perturb_pose``."""
    E = essential_matrix(rotation, translation)
    basis = tangent_basis(translation)
    skew = cross_matrix(translation)
    derivatives = np.concatenate(
        [skew @ GENERATORS @ rotation, np.stack([cross_matrix(b) @ rotation for b in basis.T])]
    )
    lines_j = points.rays_i @ E.T
    lines_i = points.rays_j @ E
    d_lines_j = (points.rays_i @ derivatives.reshape(15, 3).T).reshape(-1, 5, 3)
    d_lines_i = (points.rays_j @ derivatives.transpose(1, 0, 2).reshape(3, 15)).reshape(-1, 5, 3)
    algebraic = np.einsum("nk,nk->n", points.rays_j, lines_j)
    d_algebraic = np.einsum("npk,nk->np", d_lines_j, points.rays_j)
    variance = np.maximum(_line_variance(points, lines_i, lines_j), 1e-300)
    half_d_variance = (
        np.einsum("npk,nk->np", d_lines_i[:, :, :2], lines_i[:, :2]) / points.focal_i**2
        + np.einsum("npk,nk->np", d_lines_j[:, :, :2], lines_j[:, :2]) / points.focal_j**2
    )
    root = np.sqrt(variance)
    errors = algebraic / root
    jacobian = d_algebraic / root[:, None] - (errors / variance)[:, None] * half_d_variance
    return errors, jacobian


def cauchy_weights(errors: Array, scale: float) -> Array:
    """Weights (M,) of the Cauchy loss."""
    return 1.0 / (1.0 + (errors / scale) ** 2)


def solve_damped(information: Array, gradient: Array) -> Array:
    """The step -H^-1 g with just enough damping for a singular H."""
    damping = 1e-9 * np.trace(information) / len(information)
    step: Array = -np.linalg.solve(information + damping * np.eye(len(information)), gradient)
    return step


def refine_sampson(
    points: Correspondences,
    rotation: Array,
    translation: Array,
    scale_px: float,
    max_iterations: int,
) -> tuple[Array, Array]:
    """Refine a relative pose (3,3), (3,) by Gauss-Newton on the Cauchy loss of the Sampson error.

    Parameters
    ----------
    points : correspondences that roughly agree with the pose.
    scale_px : scale of the Cauchy loss.

    Source: Hartley and Zisserman, Multiple View Geometry, section 11.4.3 and appendix 6.8.
    """
    errors, jacobian = sampson_jacobian(points, rotation, translation)
    cost = cauchy_cost(errors, scale_px)
    for _ in range(max_iterations):
        weighted = jacobian * cauchy_weights(errors, scale_px)[:, None]
        step = solve_damped(weighted.T @ jacobian, weighted.T @ errors)
        moved = perturb_pose(
            rotation, translation, step * min(1.0, 0.3 / float(np.linalg.norm(step) + 1e-12))
        )
        new_errors, new_jacobian = sampson_jacobian(points, *moved)
        new_cost = cauchy_cost(new_errors, scale_px)
        if not new_cost < cost:
            break
        converged = cost - new_cost < 1e-6 * cost
        (rotation, translation), errors, jacobian, cost = moved, new_errors, new_jacobian, new_cost
        if converged:
            break
    return rotation, translation


def cauchy_cost(errors: Array, scale: float) -> float:
    """Sum of the Cauchy loss over errors (M,), without its constant factor."""
    return float(np.log1p((errors / scale) ** 2).sum())
