"""Two-view bundle adjustment with the points eliminated."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.rotations import GENERATORS
from snakesfm.two_view.sampson import Correspondences, cauchy_cost, cauchy_weights, solve_damped
from snakesfm.two_view.tangents import cross_matrix, perturb_pose, tangent_basis


def inverse_depths(points: Correspondences, rotation: Array, translation: Array) -> Array:
    """Inverse depths (M,) in camera i, in units of the baseline, that bring the rays closest in image j.

    Negative where the rays meet behind camera i, 0 where they are parallel.
    """
    turned = points.rays_i @ rotation.T
    # ray_j x (turned + rho t) = 0 in the least squares sense; Lagrange's identity spares one cross product
    left = points.rays_j @ cross_matrix(translation)
    along = np.einsum("nk,nk->n", points.rays_j, points.rays_j) * (turned @ translation)
    along -= np.einsum("nk,nk->n", points.rays_j, turned) * (points.rays_j @ translation)
    depths: Array = -along / np.maximum(np.einsum("nk,nk->n", left, left), 1e-300)
    return depths


def refine_bundle(
    points: Correspondences,
    rotation: Array,
    translation: Array,
    scale_px: float,
    max_iterations: int,
) -> tuple[Array, Array]:
    """Refine a relative pose (3,3), (3,) and all points on the Cauchy loss of the reprojection errors.

    A point is its place on image i and its inverse depth there, so points at infinity are allowed; the
    baseline is the unit of length. The points are eliminated from each step by their Schur complement.

    Parameters
    ----------
    points : correspondences that roughly agree with the pose.
    scale_px : scale of the Cauchy loss of a point's four residuals taken together.

    Source: Triggs et al., Bundle adjustment: a modern synthesis, section 6.1.
    """
    structure = np.column_stack([points.rays_i[:, :2], inverse_depths(points, rotation, translation)])
    errors, by_pose, by_point = _linearize(points, rotation, translation, structure)
    cost = cauchy_cost(np.linalg.norm(errors, axis=1), scale_px)
    damping = 1e-6
    for _ in range(max_iterations):
        weights = cauchy_weights(np.linalg.norm(errors, axis=1), scale_px)[:, None, None]
        H_cp = by_pose.transpose(0, 2, 1) @ (weights * by_point)
        H_pp = by_point.transpose(0, 2, 1) @ (weights * by_point)
        H_pp += damping * np.einsum("nkk->nk", H_pp)[:, :, None] * np.eye(3) + 1e-12 * np.eye(3)
        g_p = (by_point.transpose(0, 2, 1) @ (weights * errors[:, :, None]))[:, :, 0]
        eliminated = np.linalg.solve(
            H_pp, np.concatenate([H_cp.transpose(0, 2, 1), g_p[:, :, None]], axis=2)
        )
        H = np.einsum("nrp,nrq->pq", by_pose, weights * by_pose) - np.einsum(
            "npk,nkq->pq", H_cp, eliminated[:, :, :5]
        )
        g = np.einsum("nrp,nr->p", by_pose, weights[:, :, 0] * errors) - np.einsum(
            "npk,nk->p", H_cp, eliminated[:, :, 5]
        )
        step = solve_damped(H, g)
        moved = perturb_pose(rotation, translation, step)
        moved_structure = structure - eliminated[:, :, 5] - eliminated[:, :, :5] @ step
        linearized = _linearize(points, *moved, moved_structure)
        new_cost = cauchy_cost(np.linalg.norm(linearized[0], axis=1), scale_px)
        if not new_cost < cost:
            damping *= 100.0
            if damping > 1e4:
                break
            continue
        converged = cost - new_cost < 1e-6 * cost
        damping = max(damping * 0.1, 1e-9)
        (rotation, translation), structure, cost = moved, moved_structure, new_cost
        errors, by_pose, by_point = linearized
        if converged:
            break
    return rotation, translation


def _linearize(
    points: Correspondences, rotation: Array, translation: Array, structure: Array
) -> tuple[Array, Array, Array]:
    """Residuals (M,4) in pixels and their derivatives by the pose (M,4,5) and by the points (M,4,3)."""
    count = len(points)
    rays = np.column_stack([structure[:, :2], np.ones(count)])
    turned = rays @ rotation.T
    local = turned + structure[:, 2:] * translation
    depth = np.where(np.abs(local[:, 2]) > 1e-9, local[:, 2], 1e-9)
    image = local[:, :2] / depth[:, None]
    projection = np.zeros((count, 2, 3))
    projection[:, 0, 0] = projection[:, 1, 1] = points.focal_j / depth
    projection[:, :, 2] = -points.focal_j * image / depth[:, None]
    d_local = np.concatenate(
        [
            np.stack([turned @ g.T for g in GENERATORS], axis=2),
            structure[:, 2, None, None] * tangent_basis(translation)[None],
        ],
        axis=2,
    )
    by_pose = np.zeros((count, 4, 5))
    by_pose[:, 2:] = projection @ d_local
    by_point = np.zeros((count, 4, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = points.focal_i
    by_point[:, 2:, :2] = projection @ rotation[:, :2]
    by_point[:, 2:, 2] = projection @ translation
    errors = np.concatenate(
        [
            points.focal_i * (structure[:, :2] - points.rays_i[:, :2]),
            points.focal_j * (image - points.rays_j[:, :2]),
        ],
        axis=1,
    )
    return errors, by_pose, by_point
