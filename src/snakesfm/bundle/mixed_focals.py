"""Cameras that images share though they were taken with several focal lengths."""

from collections import defaultdict
from dataclasses import replace

import numpy as np

from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.principal_points import shared_cameras
from snakesfm.bundle.selection import with_some_points
from snakesfm.bundle.trials import error_shares
from snakesfm.geometry.colmap_binding import pycolmap

MAX_SPREAD = 0.02
"""Of focal lengths of one camera, the ninth decile over the first, less one: focusing changes less."""
NOISE_SHARE = 0.7
"""Of the errors, what a focal length for each image must leave at most: freedom alone takes little."""
# more points tell no more of two numbers, and cost time
MAX_POINTS = 2500


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
    before = with_some_points(reconstruction, MAX_POINTS)
    after = with_some_points(before, MAX_POINTS, shared)
    for trial in (before, after):
        adjust(trial, solving)
    focals = defaultdict(list)
    for image_id in before.reg_image_ids():
        image, own = before.image(image_id), after.image(image_id).camera_id
        if image.num_points3D:
            focals[image.camera_id].append(after.camera(own).mean_focal_length())
    found = {}
    for camera_id, share in error_shares(before, after).items():
        low, high = np.quantile(focals[camera_id], [0.1, 0.9])
        if camera_id in shared and high > (1.0 + MAX_SPREAD) * low and share < NOISE_SHARE:
            found[camera_id] = float(high / low - 1.0)
    return found
