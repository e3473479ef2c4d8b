"""pycolmap's robust triangulation, one track at a time."""

from itertools import pairwise

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.poses import to_rigid3d
from snakesfm.triangulation.interface import TriangulationLimits, TriangulationProblem, check_points


def triangulate_pycolmap(problem: TriangulationProblem, limits: TriangulationLimits) -> tuple[Array, Array]:
    """LO-RANSAC over pairs and non-linear refinement (``pycolmap.estimate_triangulation``)."""
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.min_tri_angle = float(np.radians(limits.min_angle_deg))
    options.ransac.max_error = limits.max_reprojection_error_px
    options.ransac.max_num_trials = limits.max_hypotheses
    options.ransac.random_seed = limits.seed
    used = np.unique(problem.image_ids).tolist()
    poses = {i: to_rigid3d(problem.rotations[i], problem.translations[i]) for i in used}
    cameras = {i: _camera(float(problem.focals_px[i])) for i in used}
    pixels = problem.rays * problem.focals_px[problem.image_ids][:, None]
    points = np.full((len(problem.offsets) - 1, 3), np.nan)
    images, offsets = problem.image_ids.tolist(), problem.offsets.tolist()
    for track, (start, end) in enumerate(pairwise(offsets)):
        if end - start < 2:
            continue
        seen = images[start:end]
        found = pycolmap.estimate_triangulation(
            pixels[start:end], [poses[i] for i in seen], [cameras[i] for i in seen], options
        )
        if found is not None:
            points[track] = found["xyz"]
    return check_points(problem, points, limits)


def _camera(focal_px: float) -> pycolmap.Camera:
    return pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal_px, 0.0, 0.0])
