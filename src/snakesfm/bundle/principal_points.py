"""Selection of the cameras whose principal points the model determines."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.lens_fit import MIN_IMAGES

Array = NDArray[Any]

# what is no farther than this many gaps from where it is assumed may as well be there
SIGNIFICANCE = 3.0
# more points than this tell no more of a few numbers, and cost time
POINTS_PER_HALF = 5000
COARSE = 10.0


def find_told_cameras(
    reconstruction: pycolmap.Reconstruction,
    adjust: BundleAdjuster,
    solving: SolverSettings,
    max_gap: float,
    offsets: tuple[float, float],
) -> frozenset[int]:
    """Ids of the cameras whose principal point is the same by either half of the points.

    The points are dealt into two halves, and each half adjusts a copy of the model with the principal
    points free. The formal covariance would be several times too small: neighbouring points err alike.

    Parameters
    ----------
    reconstruction : an adjusted model; stays as it is.
    adjust, solving : the solver; cameras that it holds are no candidates.
    max_gap : largest distance of the two principal points, as a share of the image's longer side.
    offsets : smallest and largest distance from the principal point so far, likewise; it must be three gaps
        too. Both halves share what the model as a whole gets wrong, so small distances prove nothing.
    """
    candidates = shared_cameras(reconstruction, solving.constant_cameras)
    if not candidates:
        return frozenset()
    held = frozenset(reconstruction.cameras) - candidates
    free = replace(solving, constant_cameras=held, refine_principal_points=True)
    found = [_of_half(reconstruction, half, adjust, free) for half in (0, 1)]
    told = set()
    for camera_id in candidates:
        camera = reconstruction.camera(camera_id)
        first, second = (points[camera_id] for points in found)
        gap = float(np.linalg.norm(first - second))
        offset = float(np.linalg.norm(0.5 * (first + second) - principal_point(camera)))
        longer = max(camera.width, camera.height)
        smallest = max(SIGNIFICANCE * gap, offsets[0] * longer)
        if gap < max_gap * longer and smallest < offset < offsets[1] * longer:
            told.add(camera_id)
    return frozenset(told)


def principal_point(camera: pycolmap.Camera) -> Array:
    """Principal point (2,) of a camera in pixels."""
    return np.array([camera.params[k] for k in camera.principal_point_idxs()])


def shared_cameras(reconstruction: pycolmap.Reconstruction, held: frozenset[int]) -> frozenset[int]:
    """Ids of the cameras of five registered images or more, but for those that are held."""
    of_images: Sequence[int] = [reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()]
    ids, counts = np.unique(np.array(of_images, dtype=np.int64), return_counts=True)
    return frozenset(ids[counts >= MIN_IMAGES].tolist()) - held


def _of_half(
    reconstruction: pycolmap.Reconstruction, half: int, adjust: BundleAdjuster, solving: SolverSettings
) -> dict[int, Array]:
    """Principal points by camera that one half of the points gives."""
    model = pycolmap.Reconstruction(reconstruction)
    points = sorted(model.point3D_ids())
    kept = set(points[half :: max(2, len(points) // POINTS_PER_HALF)])
    for point in points:
        if point not in kept:
            model.delete_point3D(point)
    adjust(model, replace(solving, function_tolerance=solving.function_tolerance * COARSE))
    return {camera_id: principal_point(camera) for camera_id, camera in model.cameras.items()}
