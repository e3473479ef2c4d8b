"""Georeferencing of a model by the GPS positions in EXIF."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.earth import Origin, local_metres
from snakesfm.geometry.poses import Similarity
from snakesfm.geometry.robust import robust_sigma

# what satellite navigation without corrections errs by at worst, height included
COARSE_ERROR_M = 20.0
# of a robust standard deviation: what counts as an inlier once the noise is measured
INLIER_SIGMAS = 3.0
LEAST_IMAGES = 4
# of which a similarity is estimated
MINIMAL_SAMPLE = 3
LEAST_INLIERS = 0.5
# positions must spread so many times farther than they err, in two directions, to tell the similarity
LEAST_SPREAD = 10.0


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
    """

    origin: Origin
    local_from_model: Similarity
    images: int
    inliers: int
    median_residual_m: float
    spread_m: tuple[float, float, float]

    @property
    def trusted(self) -> bool:
        """Whether positions agree with the model and are not on one line, about which it could turn."""
        return (
            self.inliers >= max(LEAST_IMAGES, LEAST_INLIERS * self.images)
            and self.spread_m[1] >= LEAST_SPREAD * self.median_residual_m
        )

    def summary(self) -> dict[str, Any]:
        """What summary.json says."""
        return {
            "axes": "x east, y north, z up, metres",
            "origin_latitude_longitude_altitude": list(self.origin),
            "images_with_position": self.images,
            "inliers": self.inliers,
            "median_residual_m": self.median_residual_m,
        }


def georeference(centers: Array, gps: Array, origin: Origin, seed: int) -> Georeference | None:
    """The similarity that takes camera centres to the positions in EXIF, or None where too few have one.

    Parameters
    ----------
    centers : (N,3) camera centres in the model's world, NaN where not registered.
    gps : (N,3) latitude and longitude in degrees, altitude in metres; NaN where unknown.
    origin : of the local world.
    seed : of the random draws.

    A first estimate allows for what plain satellite navigation errs; a second for what this one shows.
    """
    known = np.isfinite(gps).all(axis=1) & np.isfinite(centers).all(axis=1)
    if known.sum() < LEAST_IMAGES:
        return None
    places = local_metres(gps[known], origin)
    sources, max_error = centers[known], COARSE_ERROR_M
    found = None
    for _ in range(2):
        options = pycolmap.RANSACOptions(max_error=max_error, random_seed=seed, max_num_trials=2000)
        estimate = pycolmap.estimate_sim3d_robust(sources, places, options)
        if estimate is None:
            break
        similarity = estimate["tgt_from_src"]
        found = Similarity(
            float(similarity.scale), similarity.rotation.matrix(), np.asarray(similarity.translation)
        )
        residuals = np.linalg.norm(found.transform_points(sources) - places, axis=1)
        inliers = residuals <= max_error
        max_error = min(max(INLIER_SIGMAS * robust_sigma(residuals, 0.0), 1e-6), COARSE_ERROR_M)
    if found is None or inliers.sum() < MINIMAL_SAMPLE:
        return None
    places = places[inliers]
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))
    return Georeference(
        origin,
        found,
        int(known.sum()),
        int(inliers.sum()),
        float(np.median(residuals[inliers])),
        (float(spread[0]), float(spread[1]), float(spread[2])),
    )
