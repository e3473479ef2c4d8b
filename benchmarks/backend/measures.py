"""Errors against the truth."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.evaluation.alignment import align_poses, median_rotation
from snakesfm.geometry.rotations import angle_of


def rotation_errors_deg(averaged: Array, truth: Array) -> Array:
    """Angles (K,) to the truth of the K images that have both, aligned by the median rotation."""
    known = np.isfinite(averaged[:, 0, 0]) & np.isfinite(truth[:, 0, 0])
    gauge = averaged[known].transpose(0, 2, 1) @ truth[known]
    return np.degrees(angle_of(gauge @ median_rotation(gauge).T))


def position_errors_percent(
    rotations: Array, centers: Array, truth_rotations: Array, truth_centers: Array
) -> Array:
    """Distances (K,) to the truth of the K cameras that have a pose in both, after robust Sim(3) alignment.

    In per cent of the diagonal of the box that holds the true centres.

    Parameters
    ----------
    rotations, truth_rotations : (N,3,3) cam_from_world, NaN where unknown.
    centers, truth_centers : (N,3), NaN where unknown.
    """
    known = np.isfinite(centers[:, 0]) & np.isfinite(rotations[:, 0, 0])
    known &= np.isfinite(truth_centers[:, 0]) & np.isfinite(truth_rotations[:, 0, 0])
    if not known.any():
        return np.zeros(0)
    found, true = centers[known], truth_centers[known]
    aligned = align_poses(rotations[known], found, truth_rotations[known], true).transform_points(found)
    surveyed = truth_centers[np.isfinite(truth_centers[:, 0])]
    extent = np.linalg.norm(np.ptp(surveyed, axis=0))
    return np.asarray(100.0 * np.linalg.norm(aligned - true, axis=1) / extent)
