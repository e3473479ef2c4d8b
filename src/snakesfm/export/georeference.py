"""Georeferencing of a model by the GPS positions in EXIF."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.earth import Origin, local_metres
from snakesfm.geometry.poses import Similarity
from snakesfm.geometry.robust import robust_sigma

# the first is what satellite navigation without corrections errs by at worst, height included; within the
# others, a majority of good positions is told from others that err alike, as of a receiver that froze
ERRORS_M = (20.0, 10.0, 5.0, 2.5, 1.2)
# of a robust standard deviation: what counts as an inlier once the noise is measured
INLIER_SIGMAS = 3.0
# by least squares over the inliers, which settle after two or three
REFITS = 5
LEAST_IMAGES = 4
# of which a similarity is estimated
MINIMAL_SAMPLE = 3
LEAST_INLIERS = 0.5
# positions must spread so many times farther than they err, in two directions, to tell the similarity
LEAST_SPREAD = 10.0
# of the spread along a line: less across it is a line
LINE_RATIO = 0.05
# half of what a model upside down has at least, be it of nadir, oblique or street-level photographs
UPSIDE_DOWN = 0.5

UPSIDE_DOWN_REASON = (
    "they would turn the model upside down, as positions in a wrong hemisphere do: correct GPSLatitudeRef "
    "(N or S) and GPSLongitudeRef (E or W), without which positions count as north and east"
)
DISAGREE_REASON = "only {inliers} of {images} agree with the model"
LINE_REASON = "they lie on one line, about which the model could turn: photograph from several lines"
SPREAD_REASON = (
    "they spread over only {longer:.3g} by {shorter:.3g} m (standard deviations), at least one less than "
    "ten times their median residual of {residual:.2g} m"
)


@dataclass(frozen=True)
class Georeference:
    """A local world: x east, y north, z up, in metres from an origin.

    Parameters
    ----------
    origin : latitude and longitude in degrees, altitude in metres, WGS84.
    local_from_model : similarity from the model's world to the local one.
    images, inliers : images with a position in EXIF and a pose, and those that the similarity explains.
    median_residual_m : between the inliers' positions and EXIF's.
    spread_m : standard deviations (3,) of the inliers' positions in EXIF along their principal axes, the
        largest first; a wrong position beside a straight flight would make it look broad.
    upward : mean over these images of the upward part of ``downward_axes``, about -1 if upright.
    """

    origin: Origin
    local_from_model: Similarity
    images: int
    inliers: int
    median_residual_m: float
    spread_m: tuple[float, float, float]
    upward: float

    @property
    def refusal(self) -> str:
        """Why these positions do not tell where the model is, a clause; empty where they do."""
        longer, shorter, _ = self.spread_m
        if self.inliers < max(LEAST_IMAGES, LEAST_INLIERS * self.images):
            return DISAGREE_REASON.format(inliers=self.inliers, images=self.images)
        if shorter < LEAST_SPREAD * self.median_residual_m:
            if shorter < LINE_RATIO * longer:
                return LINE_REASON
            return SPREAD_REASON.format(longer=longer, shorter=shorter, residual=self.median_residual_m)
        # positions mirrored by a wrong hemisphere fit cameras in a plane just as well, turned over
        return UPSIDE_DOWN_REASON if self.upward > UPSIDE_DOWN else ""

    @property
    def trusted(self) -> bool:
        """Whether positions agree with the model, spread in two directions and leave it upright."""
        return not self.refusal

    def summary(self) -> dict[str, Any]:
        """What summary.json says."""
        return {
            "axes": "x east, y north, z up, metres",
            "origin_latitude_longitude_altitude": list(self.origin),
            "images_with_position": self.images,
            "inliers": self.inliers,
            "median_residual_m": self.median_residual_m,
        }


def downward_axes(rotations: Array, orientations: Array) -> Array:
    """What points down in photographs (N,3): the view direction plus the way to the lower side.

    One of the two may be level, as in street-level and in nadir photographs, but not both.

    Parameters
    ----------
    rotations : (N,3,3) cam_from_world, NaN where not registered.
    orientations : (N,) EXIF orientations 1..8, which tell the lower side of the pixels as stored.
    """
    axes = np.where(orientations >= 5, 0, 1)
    signs = np.where(np.isin(orientations, (3, 4, 7, 8)), -1.0, 1.0)
    down: Array = rotations[:, 2] + signs[:, None] * rotations[np.arange(len(rotations)), axes]
    return down


def georeference(
    centers: Array, downward: Array, gps: Array, origin: Origin, seed: int
) -> Georeference | None:
    """The similarity that takes camera centres to the positions in EXIF, or None where too few have one.

    Parameters
    ----------
    centers : (N,3) camera centres in the model's world, NaN where not registered.
    downward : (N,3) of ``downward_axes``.
    gps : (N,3) latitude and longitude in degrees, altitude in metres; NaN where unknown.
    origin : of the local world.
    seed : of the random draws.

    Of estimates that allow for several errors, the nearest to half of the positions shows how far they err;
    least squares over those within just that follow.
    """
    known = np.isfinite(gps).all(axis=1) & np.isfinite(centers).all(axis=1)
    if known.sum() < LEAST_IMAGES:
        return None
    places = local_metres(gps[known], origin)
    fit = _fit(centers[known], places, seed)
    if fit is None:
        return None
    found, residuals, inliers = fit
    spread = np.linalg.svd(places[inliers] - places[inliers].mean(axis=0), compute_uv=False) / np.sqrt(
        inliers.sum()
    )
    return Georeference(
        origin,
        found,
        int(known.sum()),
        int(inliers.sum()),
        float(np.median(residuals[inliers])),
        (float(spread[0]), float(spread[1]), float(spread[2])),
        float(np.mean(downward[known] @ found.rotation[2])),
    )


def _fit(sources: Array, places: Array, seed: int) -> tuple[Similarity, Array, Array] | None:
    """The similarity, the distances (n,) in metres that it leaves, and which of them are of inliers."""
    estimates = (_estimate(sources, places, error, seed) for error in ERRORS_M)
    found = min(
        filter(None, estimates), key=lambda each: np.median(_residuals(each, sources, places)), default=None
    )
    for _ in range(REFITS):
        if found is None:
            return None
        residuals = _residuals(found, sources, places)
        inliers = residuals <= _max_error(residuals)
        if inliers.sum() < MINIMAL_SAMPLE:
            return None
        found = _to_similarity(pycolmap.estimate_sim3d(sources[inliers], places[inliers]))
    if found is None:
        return None
    residuals = _residuals(found, sources, places)
    return found, residuals, residuals <= _max_error(residuals)


def _estimate(sources: Array, places: Array, max_error_m: float, seed: int) -> Similarity | None:
    """The similarity that most positions agree with."""
    options = pycolmap.RANSACOptions(max_error=max_error_m, random_seed=seed, max_num_trials=2000)
    estimate = pycolmap.estimate_sim3d_robust(sources, places, options)
    return None if estimate is None else _to_similarity(estimate["tgt_from_src"])


def _to_similarity(found: pycolmap.Sim3d | None) -> Similarity | None:
    if found is None:
        return None
    return Similarity(float(found.scale), found.rotation.matrix(), np.asarray(found.translation))


def _residuals(found: Similarity, sources: Array, places: Array) -> Array:
    distances: Array = np.linalg.norm(found.transform_points(sources) - places, axis=1)
    return distances


def _max_error(residuals: Array) -> float:
    """What an inlier errs by at most, in metres, from all residuals."""
    return min(max(INLIER_SIGMAS * robust_sigma(residuals, 0.0), 1e-6), ERRORS_M[0])
