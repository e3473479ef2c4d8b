"""Cameras that images share though they were taken with several focal lengths."""

from dataclasses import replace

import numpy as np

from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.principal_points import observation_errors, shared_cameras
from snakesfm.bundle.selection import with_some_points
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap

MAX_SPREAD = 0.02
"""Of focal lengths of one camera, the ninth decile over the first, less one: focusing changes less."""
NOISE_SHARE = 0.7
"""Of the errors, what a focal length for each image must leave at most: freedom alone takes little."""
# each image must see enough of them to tell its own focal length, and more cost time
POINTS_PER_IMAGE = 15
LEAST_POINTS = 2500


def find_mixed_focals(
    reconstruction: pycolmap.Reconstruction, adjust: BundleAdjuster, solving: SolverSettings
) -> dict[int, float]:
    """Cameras by id whose images differ in focal length, and by how much, 0.1 for 10 %.

    Some of the points are adjusted twice, with one focal length and with one for each image; distortion is
    held, so that few points do not determine much.

    Parameters
    ----------
    reconstruction : an adjusted model; stays as it is.
    adjust, solving : the solver; cameras that it holds, or of few images, are no candidates.
    """
    shared = shared_cameras(reconstruction, solving.constant_cameras)
    if not shared or not solving.refine_focal:
        return {}
    solving = replace(solving, refine_distortion=False)
    most = max(LEAST_POINTS, POINTS_PER_IMAGE * reconstruction.num_reg_images())
    before = with_some_points(reconstruction, most)
    after = with_some_points(before, most, shared)
    for trial in (before, after):
        adjust(trial, solving)
    shared_of, errors_before = observation_errors(before)
    own_of, errors_after = observation_errors(after)
    found = {}
    for camera_id in sorted(shared):
        # observations are in one order in both
        mine = shared_of == camera_id
        if not mine.any():
            continue
        focals = [
            Camera.of_pycolmap(after.camera(own)).focal_px for own in np.unique(own_of[mine]).tolist()
        ]
        low, high = np.quantile(focals, [0.1, 0.9])
        share = np.median(errors_after[mine]) / max(np.median(errors_before[mine]), 1e-9)
        if high > (1.0 + MAX_SPREAD) * low and share < NOISE_SHARE:
            found[camera_id] = float(high / low - 1.0)
    return found
