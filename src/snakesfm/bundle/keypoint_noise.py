"""How far keypoints are from where they should be, as the model tells."""

import numpy as np

from snakesfm.geometry.colmap_binding import pycolmap


def keypoint_noise_px(reconstruction: pycolmap.Reconstruction) -> float:
    """Standard deviation per axis of the keypoints, from the reprojection errors of the model.

    The median over the points withstands wrong observations. The mean length of an error is sqrt(pi/2)
    standard deviations, and each point takes three of the two degrees of freedom per observation.
    """
    reconstruction.update_point_3d_errors()
    points = reconstruction.points3D.values()
    errors = np.array([point.error for point in points])
    lengths = np.array([point.track.length() for point in points])
    if not len(errors):
        return 1.0
    return float(np.median(errors / np.sqrt(np.pi / 2 * (1 - 1.5 / lengths))))
