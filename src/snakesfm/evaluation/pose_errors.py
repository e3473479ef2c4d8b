"""Errors of camera poses against reference poses, and the areas under their recall curves."""

from collections.abc import Sequence

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.poses import center_of, has_pose
from snakesfm.geometry.rotations import angle_between

FAILED_DEG = 180.0
# all pairs of 2,000 images; of more images as many pairs are drawn
MOST_PAIRS = 4_000_000
COINCIDENT_RATIO = 1e-9


def chordal_angle_deg(a: Array, b: Array) -> Array:
    """Angles (...,) in degrees between rotations (..., 3, 3), from their Frobenius distance."""
    distance = np.linalg.norm(a - b, axis=(-2, -1))
    angles: Array = np.degrees(2.0 * np.arcsin(np.clip(distance / np.sqrt(8.0), 0.0, 1.0)))
    return angles


def pose_auc(errors_deg: Array, thresholds_deg: Sequence[float]) -> list[float]:
    """Area under the recall curve up to each threshold, in percent.

    The curve starts at (0, 0), is linear between the sorted errors and level after the last one below the
    threshold, as in the benchmarks of COLMAP and GLOMAP. Without errors every area is 0.
    """
    if len(errors_deg) == 0:
        return [0.0 for _ in thresholds_deg]
    ordered = np.r_[0.0, np.sort(errors_deg)]
    recall = np.arange(len(ordered)) / (len(ordered) - 1)
    areas = []
    for threshold in thresholds_deg:
        last = int(np.searchsorted(ordered, threshold, side="right"))
        curve = np.r_[recall[:last], recall[last - 1]]
        areas.append(100.0 * float(np.trapezoid(curve, np.r_[ordered[:last], threshold])) / threshold)
    return areas


def compared_images(count: int, most_pairs: int = MOST_PAIRS) -> Array:
    """The images (n,k) that each of n images is compared with, ascending; a pair is ordered.

    All others, or of many images so many that there are no more than about ``most_pairs`` pairs: the same
    steps through the list of images, drawn once, lead from every image to its partners.
    """
    partners = max(min(count - 1, most_pairs // max(count, 1)), 0)
    steps = np.random.default_rng(count).choice(max(count - 1, 0), partners, replace=False) + 1
    return np.sort((np.arange(count)[:, None] + steps) % max(count, 1), axis=1)


def relative_pose_errors(
    rotations: Array,
    translations: Array,
    reference_rotations: Array,
    reference_translations: Array,
    min_baseline: float = 0.0,
) -> tuple[Array, Array]:
    """Rotation and translation-direction errors of the relative poses of ordered pairs.

    The pairs are those of :func:`compared_images`: all, or a sample of so many that memory is bounded.

    Parameters
    ----------
    rotations, translations : (n,3,3) and (n,3) cam_from_world; NaN where the image is not registered.
    reference_rotations, reference_translations : the same of the reference, without NaN.
    min_baseline : pairs whose reference centres are no farther apart than this have no direction.

    Returns
    -------
    rotation_deg, direction_deg : (n k,) float64; 180 where an image is not registered; the direction's
        error is 0 where the reference has none and 180 where only the model has none.
    """
    count = len(reference_rotations)
    registered = has_pose(rotations, translations)
    model_rotations = np.where(registered[:, None, None], rotations, np.eye(3))
    centers = center_of(model_rotations, np.where(registered[:, None], translations, 0.0))
    reference_centers = center_of(reference_rotations, reference_translations)
    coincident = COINCIDENT_RATIO * float(np.linalg.norm(np.ptp(centers, axis=0))) if count else 0.0
    # |R_j R_i^T - R*_j R*_i^T| is |D_j - D_i| with D = R*^T R, so no pair needs a product.
    differences = np.swapaxes(reference_rotations, 1, 2) @ model_rotations
    compared = compared_images(count)
    rotation_deg = np.zeros(compared.shape)
    direction_deg = np.zeros_like(rotation_deg)
    for j in range(count):
        others = compared[j]
        rotation_deg[j] = chordal_angle_deg(differences[others], differences[j])
        reference_direction = (reference_centers[others] - reference_centers[j]) @ reference_rotations[j].T
        direction = (centers[others] - centers[j]) @ model_rotations[j].T
        angles = np.degrees(angle_between(direction, reference_direction))
        angles[np.linalg.norm(direction, axis=1) <= coincident] = FAILED_DEG
        angles[np.linalg.norm(reference_direction, axis=1) <= min_baseline] = 0.0
        failed = ~(registered[others] & registered[j])
        rotation_deg[j, failed] = FAILED_DEG
        direction_deg[j] = np.where(failed, FAILED_DEG, angles)
    return rotation_deg.ravel(), direction_deg.ravel()
