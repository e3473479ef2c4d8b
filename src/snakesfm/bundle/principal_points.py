"""Selection of the cameras whose principal points the model determines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.reading import Tracks, read_tracks_and_pixels
from snakesfm.bundle.selection import LONG_TRACK, with_points
from snakesfm.bundle.trials import error_shares
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.lens_fit import MIN_IMAGES

# what is no farther than this many gaps from where it is assumed may as well be there
SIGNIFICANCE = 3.0
# the way of a far one is long, and neither half has gone it to the end
FAR_SIGNIFICANCE = 10.0
# more than these tell no more of a few numbers, and cost time
POINTS_PER_HALF = 5000
OBSERVATIONS_PER_HALF = LONG_TRACK * POINTS_PER_HALF
COARSE = 10.0
# a third of the image cut off on one side makes a quarter; the border is at a half
LARGEST_OFFSET = 0.35
FAR_OFFSET = 0.02
FAR_SHARE = 0.9
"""Of the errors, what a far principal point must leave at most. Those of images that were cropped leave .24
to .85 of them; one that makes up for another distortion than the model's, .93."""


@dataclass(frozen=True)
class ToldCameras:
    """The cameras, by their ids, whose principal point a model tells.

    Parameters
    ----------
    told, refused : how far from where it is assumed the principal point seems to be, as a share of the
        image's longer side, where that is believed, and where it is too far for how little the errors fall.
    """

    told: Mapping[int, float]
    refused: Mapping[int, float]

    @property
    def moves_far(self) -> bool:
        """Whether a principal point is so far off that the model before was bent and lost observations."""
        return max(self.told.values(), default=0.0) > FAR_OFFSET


def find_told_cameras(
    reconstruction: pycolmap.Reconstruction,
    adjust: BundleAdjuster,
    solving: SolverSettings,
    max_gap: float,
    offsets: tuple[float, float],
) -> ToldCameras:
    """Cameras whose principal point is the same by either half of the points.

    The points are dealt into two halves, and each half adjusts a copy of the model with the principal
    points free. The formal covariance would be several times too small: neighbouring points err alike.

    Both halves share what the model as a whole gets wrong. So small offsets prove nothing, and large ones,
    as of images that were all cropped alike, must lower the errors clearly. No offset may raise them.

    Parameters
    ----------
    reconstruction : an adjusted model; stays as it is.
    adjust, solving : the solver; cameras that it holds are no candidates.
    max_gap : largest distance of the two principal points, as a share of the image's longer side; a tenth
        of the way from the principal point so far is allowed too.
    offsets : smallest distance from the principal point so far, likewise, which must be three gaps too, and
        the one from which on the errors must fall clearly.
    """
    candidates = shared_cameras(reconstruction, solving.constant_cameras)
    if not candidates:
        return ToldCameras({}, {})
    held = frozenset(reconstruction.cameras) - candidates
    free = replace(solving, constant_cameras=held, refine_principal_points=True)
    dealt = read_tracks_and_pixels(reconstruction)
    halves = [_adjusted_half(reconstruction, *dealt, half, adjust, free) for half in (0, 1)]
    steady = {}
    for camera_id in sorted(candidates):
        camera = reconstruction.camera(camera_id)
        first, second = (principal_point(half.camera(camera_id)) for half in halves)
        gap = float(np.linalg.norm(first - second))
        offset = float(np.linalg.norm(0.5 * (first + second) - principal_point(camera)))
        longer = max(camera.width, camera.height)
        steady_gap = max(max_gap * longer, offset / FAR_SIGNIFICANCE)
        if gap < steady_gap and offset > max(SIGNIFICANCE * gap, offsets[0] * longer):
            steady[camera_id] = offset / longer
    if not steady:
        return ToldCameras({}, {})
    fixed = _adjusted_half(reconstruction, *dealt, 0, adjust, replace(free, refine_principal_points=False))
    shares = error_shares(fixed, halves[0])
    told, refused = {}, {}
    for camera_id, offset in steady.items():
        near = offset < offsets[1]
        if shares[camera_id] < (1.0 if near else FAR_SHARE) and (near or offset < LARGEST_OFFSET):
            told[camera_id] = offset
        elif not near:
            refused[camera_id] = offset
    return ToldCameras(told, refused)


def principal_point(camera: pycolmap.Camera) -> Array:
    """Principal point (2,) of a camera in pixels."""
    return np.array([camera.params[k] for k in camera.principal_point_idxs()])


def shared_cameras(reconstruction: pycolmap.Reconstruction, held: frozenset[int]) -> frozenset[int]:
    """Ids of the cameras of five registered images or more, but for those that are held."""
    of_images: Sequence[int] = [reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()]
    ids, counts = np.unique(np.array(of_images, dtype=np.int64), return_counts=True)
    return frozenset(ids[counts >= MIN_IMAGES].tolist()) - held


def _adjusted_half(
    reconstruction: pycolmap.Reconstruction,
    tracks: Tracks,
    pixels: Array,
    half: int,
    adjust: BundleAdjuster,
    solving: SolverSettings,
) -> pycolmap.Reconstruction:
    """A copy of the model of one half of the points, adjusted."""
    chosen = np.zeros(len(tracks.points), dtype=bool)
    share = max(2, len(chosen) // POINTS_PER_HALF, len(tracks.images) // OBSERVATIONS_PER_HALF)
    chosen[half::share] = True
    model = with_points(reconstruction, tracks, pixels, chosen)
    adjust(model, replace(solving, function_tolerance=solving.function_tolerance * COARSE))
    return model
