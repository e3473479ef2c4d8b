"""Georeferencing of a model by the GPS positions in EXIF."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.earth import Origin, local_metres
from snakesfm.geometry.poses import Similarity, lower_sides
from snakesfm.geometry.robust import robust_sigma
from snakesfm.image_names import natural_key

# the first is what satellite navigation without corrections errs by at worst, height included; within the
# others, a majority of good positions is told from others that err alike, as of a receiver that froze
ERRORS_M = (20.0, 10.0, 5.0, 2.5, 1.2)
# of a robust standard deviation: what counts as an inlier once the noise is measured
INLIER_SIGMAS = 3.0
# by least squares over the inliers, which settle after two or three
REFITS = 5
# of the search for steps of altitude, as the model tilts less without them
STEP_ROUNDS = 3
# tangents of 0.1 and 0.3 degrees: what steps may turn a model by without further proof, the second where it
# stood on one part between steps, as such a part tells the tilt less well
LEAST_TURN = 0.00175
PART_TURN = 0.00525
# of the positions, that a model that stands on all parts agrees with
LEAST_USUAL = 0.7
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
# times the median residual, where positions mirrored east-west fit worse, or else better, beyond doubt
CLEARLY = 2.0

UPSIDE_DOWN_REASON = (
    "the positions would turn the model upside down, as those in a wrong hemisphere do: correct "
    "GPSLatitudeRef (N or S) and GPSLongitudeRef (E or W), without which they count as north and east; or "
    "cameras look up or are mounted upside down: then set georeference: true"
)
MIRRORED_REASON = (
    "the positions are mirrored, as those in a wrong hemisphere are: correct GPSLatitudeRef (N or S) and "
    "GPSLongitudeRef (E or W), without which they count as north and east"
)
DISAGREE_REASON = "only {inliers} of {images} positions agree with the model"
LINE_REASON = (
    "the positions lie on one line, about which the model could turn: photograph from several lines"
)
SPREAD_REASON = (
    "the positions spread over only {longer:.3g} by {shorter:.3g} m (standard deviations), and the shorter "
    "must be ten times their median residual of {residual:.2g} m: photograph a larger area, or use "
    "more accurate GPS"
)
ALTITUDE_STEPS = (
    "The altitudes in EXIF step by {steps}, as where a barometer starts anew: the steps were taken out, so "
    "heights in the model are those of the longest part between steps."
)

INVERTED = (
    "Cameras seem to look up or to be mounted upside down, as the GPS positions in EXIF say: check that z "
    "is up in the model."
)
FEW_AGREE = (
    "Only {inliers} of {images} GPS positions in EXIF agree with the model, which is placed by these: "
    "check the others, e.g. for altitudes that step from flight to flight."
)
DOUBTFUL_STEPS = (
    "The altitudes in EXIF seem to step at {places} (first '{first}'), but a drift of the barometer or a "
    "bent model would look alike: they were left in, so the model may be tilted; crossing flight lines "
    "would tell them apart."
)


@dataclass(frozen=True)
class Georeference:
    """A local world: x east, y north, z up, in metres from an origin.

    Parameters
    ----------
    origin : latitude and longitude in degrees, altitude in metres, WGS84.
    local_from_model : similarity from the model's world to the local one.
    images, inliers : images with a position in EXIF and a pose, and those that the similarity explains.
    median_residual_m, median_horizontal_m, median_vertical_m : distances of the inliers' positions from
        EXIF's, in space, on the map and in height.
    spread_m : standard deviations (3,) of the inliers' positions in EXIF along their principal axes, the
        largest first; a wrong position beside a straight flight would make it look broad.
    altitude_steps : rows of the images from which on EXIF's altitudes are higher, and by how many metres;
        the similarity is of altitudes without these steps.
    doubtful_steps : rows of the images where altitudes seem to step but were left as they are, because a
        tilt or a drift looks much the same.
    upward : mean over these images of the upward part of ``downward_axes``, about -1 if upright.
    mirrored_ratio : of the median residuals of all positions mirrored east-west and as they are; 1 where
        they fit equally, as in a plane, and where there is no need to know.
    """

    origin: Origin
    local_from_model: Similarity
    images: int
    inliers: int
    median_residual_m: float
    median_horizontal_m: float
    median_vertical_m: float
    spread_m: tuple[float, float, float]
    altitude_steps: tuple[tuple[int, float], ...]
    doubtful_steps: tuple[int, ...]
    upward: float
    mirrored_ratio: float = 1.0

    @property
    def refusal(self) -> str:
        """Why these positions do not tell where the model is, a clause; empty where they do."""
        longer, shorter, _ = self.spread_m
        if self.mirrored_ratio < 1.0 / CLEARLY:
            return MIRRORED_REASON
        if self.inliers < max(LEAST_IMAGES, LEAST_INLIERS * self.images):
            return DISAGREE_REASON.format(inliers=self.inliers, images=self.images)
        if shorter < LEAST_SPREAD * self.median_residual_m:
            if shorter < LINE_RATIO * longer:
                return LINE_REASON
            return SPREAD_REASON.format(longer=longer, shorter=shorter, residual=self.median_residual_m)
        # positions mirrored by a wrong hemisphere fit cameras in a plane just as well, turned over
        return UPSIDE_DOWN_REASON if self.upward > UPSIDE_DOWN and self.mirrored_ratio <= CLEARLY else ""

    @property
    def trusted(self) -> bool:
        """Whether positions agree with the model, spread in two directions and leave it upright."""
        return not self.refusal

    def summary(self, names: Sequence[str]) -> dict[str, Any]:
        """What summary.json says, with the names of all images."""
        return {
            "axes": "x east, y north, z up, metres",
            "origin_latitude_longitude_altitude": list(self.origin),
            "rotation_from_adjustment": self.local_from_model.rotation.tolist(),
            "images_with_position": self.images,
            "inliers": self.inliers,
            "median_residual_m": self.median_residual_m,
            "median_horizontal_residual_m": self.median_horizontal_m,
            "median_vertical_residual_m": self.median_vertical_m,
            "altitude_steps": [
                {"from_image": names[row], "metres": metres} for row, metres in self.altitude_steps
            ],
        }

    def warnings(self, names: Sequence[str]) -> list[str]:
        """Sentences on what is unusual though positions are trusted, with the ``names`` of all images."""
        warnings = self._step_warnings(names)
        if self.trusted and self.inliers < LEAST_USUAL * self.images:
            warnings.append(FEW_AGREE.format(inliers=self.inliers, images=self.images))
        if self.trusted and self.upward > UPSIDE_DOWN:
            warnings.append(INVERTED)
        return warnings

    def _step_warnings(self, names: Sequence[str]) -> list[str]:
        if self.doubtful_steps:
            count = len(self.doubtful_steps)
            places = f"{count} images" if count > 1 else "one image"
            return [DOUBTFUL_STEPS.format(places=places, first=names[self.doubtful_steps[0]])]
        if not self.altitude_steps:
            return []
        steps = ", ".join(f"{metres:+.1f} m from '{names[row]}' on" for row, metres in self.altitude_steps)
        return [ALTITUDE_STEPS.format(steps=steps)]


def taking_order(names: Sequence[str]) -> Array:
    """Rows (N,) of images by folder, and in a folder by the numbers in their names."""

    def key(row: int) -> tuple[Any, Any]:
        return natural_key(str(PurePosixPath(names[row]).parent)), natural_key(names[row])

    return np.array(sorted(range(len(names)), key=key), np.int64)


def downward_axes(rotations: Array, orientations: Array) -> Array:
    """What points down in photographs (N,3): the view direction plus the way to the lower side.

    One of the two may be level, as in street-level and in nadir photographs, but not both.

    Parameters
    ----------
    rotations, orientations : see :func:`snakesfm.geometry.poses.lower_sides`.
    """
    down: Array = rotations[:, 2] + lower_sides(rotations, orientations)
    return down


def georeference(
    centers: Array, downward: Array, gps: Array, origin: Origin, order: Array, seed: int
) -> Georeference | None:
    """The similarity that takes camera centres to the positions in EXIF, or None where too few have one.

    Parameters
    ----------
    centers : (N,3) camera centres in the model's world, NaN where not registered.
    downward : (N,3) of ``downward_axes``.
    gps : (N,3) latitude and longitude in degrees, altitude in metres; NaN where unknown.
    origin : of the local world.
    order : (N,) rows in the order in which the images were taken, where altitudes may step.
    seed : of the random draws.

    Of estimates that allow for several errors, the nearest to half of the positions shows how far they err;
    least squares over those within just that follow.
    """
    known = np.asarray(np.isfinite(gps).all(axis=1) & np.isfinite(centers).all(axis=1))
    rows = order[known[order]]
    if len(rows) < LEAST_IMAGES:
        return None
    places = local_metres(gps[rows], origin)
    fit = _fit(centers[rows], places, seed)
    if fit is None:
        return None
    fit, steps, doubtful = _without_steps(fit, centers[rows], places, seed)
    places, offsets = fit.places[fit.inliers], fit.offsets[fit.inliers]
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))
    found = Georeference(
        origin,
        fit.similarity,
        len(rows),
        len(places),
        float(np.median(np.linalg.norm(offsets, axis=1))),
        float(np.median(np.linalg.norm(offsets[:, :2], axis=1))),
        float(np.median(np.abs(offsets[:, 2]))),
        (float(spread[0]), float(spread[1]), float(spread[2])),
        tuple((int(rows[place]), metres) for place, metres in steps),
        tuple(int(rows[place]) for place in doubtful),
        float(np.mean(downward[rows] @ fit.similarity.rotation[2])),
    )
    return (
        found if found.trusted else replace(found, mirrored_ratio=_mirrored_ratio(fit, centers[rows], seed))
    )


class _Fit(NamedTuple):
    """A similarity, the positions (n,3) that it is of, what it leaves (n,3), and its inliers (n,) bool."""

    similarity: Similarity
    places: Array
    offsets: Array
    inliers: Array

    @property
    def median_residual_m(self) -> float:
        """Of all positions."""
        return float(np.median(np.linalg.norm(self.offsets, axis=1)))


def _fit(sources: Array, places: Array, seed: int) -> _Fit | None:
    estimates = (_estimate(sources, places, error, seed) for error in ERRORS_M)
    fits = [_fit_of(found, sources, places) for found in estimates if found is not None]
    fit = min(fits, key=lambda fit: fit.median_residual_m, default=None)
    for _ in range(REFITS):
        if fit is None or fit.inliers.sum() < MINIMAL_SAMPLE:
            return None
        found = _to_similarity(pycolmap.estimate_sim3d(sources[fit.inliers], places[fit.inliers]))
        fit = None if found is None else _fit_of(found, sources, places)
    return fit


def _mirrored_ratio(fit: _Fit, sources: Array, seed: int) -> float:
    """How many times farther positions are from the model mirrored east-west; 1 if most agree with neither.

    Mirrored north-south, they are the same but for a turn.
    """
    mirrored = _fit(sources, fit.places * [-1.0, 1.0, 1.0], seed)
    if mirrored is None:
        return np.inf
    ratio = mirrored.median_residual_m / max(fit.median_residual_m, 1e-6)
    better = mirrored if ratio < 1.0 else fit
    return ratio if better.inliers.mean() >= LEAST_INLIERS else 1.0


def _without_steps(
    fit: _Fit, sources: Array, places: Array, seed: int
) -> tuple[_Fit, list[tuple[int, float]], list[int]]:
    """The fit to positions without steps of altitude, the steps, and where doubtful ones are left in."""
    # loaded here, as models without GPS do without scipy
    from snakesfm.export.altitude_steps import altitude_steps, is_more_level

    given = fit
    steps: list[tuple[int, float]] = []
    for _ in range(STEP_ROUNDS):
        centers = fit.similarity.transform_points(sources)
        rows = np.flatnonzero(_is_near_on_map(fit))
        found = [(int(rows[k]), metres) for k, metres in altitude_steps(centers[rows], places[rows, 2])]
        better = _fit(sources, _levelled(places, found), seed) if found else None
        if better is None or better.median_residual_m >= fit.median_residual_m:
            break
        fit, steps = better, found
    if not steps:
        return fit, [], []
    rows = np.flatnonzero(_is_near_on_map(given))
    doubtful = [place for place, _ in steps]
    centers = given.similarity.transform_points(sources)[rows]
    up = given.similarity.rotation @ fit.similarity.rotation[2]
    slope = up[:2] / up[2]
    harmless = LEAST_TURN if given.inliers.mean() >= LEAST_USUAL else PART_TURN
    if np.linalg.norm(slope) <= harmless or is_more_level(
        centers, places[rows, 2], np.searchsorted(rows, doubtful).tolist(), slope
    ):
        return fit, steps, []
    return given, [], doubtful


def _is_near_on_map(fit: _Fit) -> Array:
    """Positions (n,) bool that agree but for their altitude."""
    sideways = np.linalg.norm(fit.offsets[:, :2], axis=1)
    near: Array = sideways <= _max_error(sideways)
    return near


def _levelled(places: Array, steps: Sequence[tuple[int, float]]) -> Array:
    """Positions (n,3) without steps, at the heights of the longest part between them."""
    ends = [0, *(place for place, _ in steps), len(places)]
    heights = np.cumsum([0.0, *(metres for _, metres in steps)])
    lengths = np.diff(ends)
    level = np.array(places)
    level[:, 2] -= np.repeat(heights - heights[np.argmax(lengths)], lengths)
    return level


def _estimate(sources: Array, places: Array, max_error_m: float, seed: int) -> Similarity | None:
    """The similarity that most positions agree with."""
    options = pycolmap.RANSACOptions(max_error=max_error_m, random_seed=seed, max_num_trials=2000)
    estimate = pycolmap.estimate_sim3d_robust(sources, places, options)
    return None if estimate is None else _to_similarity(estimate["tgt_from_src"])


def _to_similarity(found: pycolmap.Sim3d | None) -> Similarity | None:
    if found is None:
        return None
    return Similarity(float(found.scale), found.rotation.matrix(), np.asarray(found.translation))


def _fit_of(found: Similarity, sources: Array, places: Array) -> _Fit:
    offsets = found.transform_points(sources) - places
    residuals = np.linalg.norm(offsets, axis=1)
    return _Fit(found, places, offsets, residuals <= _max_error(residuals))


def _max_error(residuals: Array) -> float:
    """What an inlier errs by at most, in metres, from all residuals."""
    return min(max(INLIER_SIGMAS * robust_sigma(residuals, 0.0), 1e-6), ERRORS_M[0])
