"""Robust Sim(3) alignment of camera poses to reference poses."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.evaluation.pose_errors import compared_images
from snakesfm.geometry.poses import Similarity
from snakesfm.geometry.robust import robust_sigma

ITERATIONS = 100
TOLERANCE = 1e-12
MOST_PAIRS = 400_000


def project_to_so3(matrix: Array) -> Array:
    """The rotation (3,3) nearest to a matrix in Frobenius norm (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(u @ vt)) or 1.0
    rotation: Array = u @ np.diag([1.0, 1.0, sign]) @ vt
    return rotation


def median_rotation(rotations: Array) -> Array:
    """L1 (geodesic-like) mean of rotations (n,3,3): the chordal median by Weiszfeld's iteration.

    Half of the rotations may be wrong (Hartley, Aftab, Trumpf: L1 rotation averaging, CVPR 2011).
    """
    current = project_to_so3(np.median(rotations, axis=0))
    for _ in range(ITERATIONS):
        weights = 1.0 / np.maximum(np.linalg.norm(rotations - current, axis=(1, 2)), 1e-9)
        following = project_to_so3(np.einsum("n,nij->ij", weights, rotations))
        moved = np.linalg.norm(following - current)
        current = following
        if moved < TOLERANCE:
            break
    return current


def _median_scale_translation(points: Array, reference: Array) -> tuple[float, Array]:
    """Scale and translation between rotated centres by medians of distances and of offsets."""
    partners = compared_images(len(points), MOST_PAIRS)
    first, second = np.repeat(np.arange(len(points)), partners.shape[1]), partners.ravel()
    baselines = np.linalg.norm(points[first] - points[second], axis=1)
    reference_baselines = np.linalg.norm(reference[first] - reference[second], axis=1)
    usable = (baselines > 0) & (reference_baselines > 0)
    scale = float(np.median(reference_baselines[usable] / baselines[usable])) if usable.any() else 1.0
    return scale, np.median(reference - scale * points, axis=0)


def align_poses(
    rotations: Array, centers: Array, reference_rotations: Array, reference_centers: Array
) -> Similarity:
    """The Sim(3) that carries a model's cameras onto the reference's.

    Rotations and centres are fitted together, which also determines the transform for two cameras or for
    cameras on a line. Cauchy weights with scales re-estimated from the residuals' medians keep a wrong
    minority from moving the result. Every step is closed form: with scale and weights fixed, both terms are
    linear in the rotation (orthogonal Procrustes; Umeyama, PAMI 1991 for the scale).

    Parameters
    ----------
    rotations, reference_rotations : (n,3,3) float64 cam_from_world, n >= 1.
    centers, reference_centers : (n,3) float64 camera centres in the model's and the reference's units.
    """
    differences = np.swapaxes(reference_rotations, 1, 2) @ rotations
    rotation = median_rotation(differences)
    scale, translation = _median_scale_translation(centers @ rotation.T, reference_centers)
    extent = float(np.linalg.norm(np.ptp(reference_centers, axis=0))) or 1.0
    estimate = Similarity(scale, rotation, translation)
    for _ in range(ITERATIONS):
        former = estimate
        position_errors = np.linalg.norm(reference_centers - estimate.transform_points(centers), axis=1)
        rotation_errors = np.linalg.norm(differences - estimate.rotation, axis=(1, 2)) / np.sqrt(2.0)
        sigma_position = robust_sigma(position_errors, 1e-9 * extent)
        sigma_rotation = robust_sigma(rotation_errors, 1e-9)
        squared = (position_errors / sigma_position) ** 2 + (rotation_errors / sigma_rotation) ** 2
        weights = 1.0 / (1.0 + squared / 4.0)
        estimate = _weighted_step(
            differences,
            centers,
            reference_centers,
            weights,
            estimate.scale,
            (sigma_position, sigma_rotation),
        )
        moved = abs(estimate.scale / former.scale - 1) + np.linalg.norm(estimate.rotation - former.rotation)
        if moved + np.linalg.norm(estimate.translation - former.translation) / extent < TOLERANCE:
            break
    return estimate


def _weighted_step(
    differences: Array,
    centers: Array,
    reference: Array,
    weights: Array,
    scale: float,
    sigmas: tuple[float, float],
) -> Similarity:
    total = weights.sum()
    mean, reference_mean = weights @ centers / total, weights @ reference / total
    moved, reference_moved = centers - mean, reference - reference_mean
    correlation = np.einsum("n,ni,nj->ij", weights, reference_moved, moved)
    rotation_term = np.einsum("n,nij->ij", weights, differences) / (2.0 * sigmas[1] ** 2)
    rotation = project_to_so3(scale * correlation / sigmas[0] ** 2 + rotation_term)
    spread = float(weights @ np.sum(moved**2, axis=1))
    fitted = float(np.sum(rotation * correlation))
    if spread > 0 and fitted > 0:
        scale = fitted / spread
    return Similarity(scale, rotation, reference_mean - scale * rotation @ mean)
