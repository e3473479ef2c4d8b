"""Focal lengths of uncalibrated cameras from matched pairs and EXIF."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.calibration.adjustment import Each, FocalAdjustment, adjust_condensed, adjust_focals
from snakesfm.calibration.condensed import condense_pairs
from snakesfm.calibration.epipolar import EpipolarPair, estimate_epipolar_pair
from snakesfm.calibration.profiles import scan_focals
from snakesfm.calibration.votes import vote_focals
from snakesfm.geometry.camera import Camera

if TYPE_CHECKING:
    from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions

GIVEN = "given"
EXIF = "exif"
ESTIMATED = "estimated"
CONTRADICTION_SIGMAS = 3.0
# a default focal length is a worse guess than what a single pair tells
VOTES_WITHOUT_EXIF = 1


@dataclass(frozen=True)
class MatchedPair:
    """Matched keypoints (M,2) float32 in pixels of two images, best first, rows of the cameras, a seed."""

    camera_i: int
    camera_j: int
    points_i: Array
    points_j: Array
    seed: int


@dataclass(frozen=True)
class CalibratedFocals:
    """Cameras with the focal lengths that are believed.

    Parameters
    ----------
    cameras : with source ``estimated`` where the matches told the focal length.
    sigmas : (C,) relative standard deviations; 0 where given, NaN where a default is kept.
    pair_counts : (C,) int32, pairs that agree with the estimate.
    """

    cameras: list[Camera]
    sigmas: Array
    pair_counts: Array


def choose_pairs(
    pairs: Array, counts: Array, camera_ids: Array, free: Array, per_camera: int, min_matches: int
) -> Array:
    """Rows (K,) of the pairs that shall vote: strong ones, spread over the images.

    Parameters
    ----------
    pairs, counts : (P,2) image rows, sorted, and (P,) numbers of matches.
    camera_ids : (N,) camera of each image.
    free : (C,) bool, cameras whose focal length is looked for.
    per_camera : a camera's strongest pairs are taken until it has this many.

    An image takes part in no more pairs than its share of its camera's, so that the pairs of a long
    sequence come from all of it. The number of pairs grows with that of the cameras, not of the images.
    """
    images_of = np.bincount(camera_ids, minlength=len(free))
    share = np.ceil(2.0 * per_camera / np.maximum(images_of, 1)).astype(int)
    share[images_of < 3] = per_camera
    room = share[camera_ids].tolist()
    least = [-most for most in room]
    # given cameras want none
    wanted = np.where(free, per_camera, 0).tolist()
    wanting = int(np.count_nonzero(free & (images_of > 0)))
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= min_matches]
    chosen: list[int] = []
    for row, (i, j), cameras in zip(
        order.tolist(), pairs[order].tolist(), camera_ids[pairs[order]].tolist(), strict=True
    ):
        if not wanting:
            break
        if all(wanted[camera] <= 0 for camera in cameras) or max(room[i], room[j]) <= 0:
            continue
        if room[i] <= least[i] or room[j] <= least[j]:
            continue
        chosen.append(row)
        for camera in set(cameras):
            wanted[camera] -= 1
            wanting -= wanted[camera] == 0
        room[i] -= 1
        room[j] -= 1
    return np.array(sorted(chosen), dtype=np.int64)


def calibrate_focals(
    pairs: Sequence[MatchedPair],
    cameras: Sequence[Camera],
    options: "CalibrateCamerasOptions",
    threads: int = 1,
) -> CalibratedFocals:
    """Estimate the focal length of every camera that is not given.

    A vote of the fundamental matrices and a scan of the true errors find the neighbourhood, an adjustment
    of all pairs the value; a focal length that too few pairs tell, or too uncertainly, stays at its prior.
    The result does not depend on ``threads``.
    """
    given = np.array([camera.source == GIVEN for camera in cameras], dtype=bool)
    from_exif = np.array([camera.source == EXIF for camera in cameras], dtype=bool)
    prior = np.array([camera.focal_px for camera in cameras], dtype=np.float64)
    largest = np.array([max(camera.width, camera.height) for camera in cameras], dtype=np.float64)
    low, high = options.min_focal_ratio * largest, options.max_focal_ratio * largest
    free = ~given
    # most of the time is spent in poselib and OpenCV, which run without Python's lock
    with ThreadPoolExecutor(threads) as pool:
        usable = _epipolar_pairs(pairs, cameras, prior, options, pool.map)
        adjustment = _adjust(usable, prior, free, low, high, options, pool.map)
    return _believe(cameras, prior, from_exif, free, low, high, adjustment, options)


def _epipolar_pairs(
    pairs: Sequence[MatchedPair],
    cameras: Sequence[Camera],
    prior: Array,
    options: "CalibrateCamerasOptions",
    each: Each,
) -> list[EpipolarPair]:
    def estimate(pair: MatchedPair) -> EpipolarPair | None:
        return estimate_epipolar_pair(
            pair.camera_i,
            pair.camera_j,
            cameras[pair.camera_i].normalize(pair.points_i) * prior[pair.camera_i],
            cameras[pair.camera_j].normalize(pair.points_j) * prior[pair.camera_j],
            options.max_error_px,
            options.planar_ratio,
            pair.seed,
        )

    return [pair for pair in each(estimate, pairs) if pair is not None]


def _adjust(
    pairs: Sequence[EpipolarPair],
    prior: Array,
    free: Array,
    low: Array,
    high: Array,
    options: "CalibrateCamerasOptions",
    each: Each,
) -> FocalAdjustment:
    # the prior only keeps focal lengths that no pair tells in their place
    weak = np.full(len(prior), options.default_sigma)
    condensed = condense_pairs(pairs)
    start = vote_focals(pairs, prior, free, low, high)
    if len(prior) > 1:
        start = adjust_condensed(condensed, start, free, prior, weak)
    # focal lengths that are given stay, however short or long
    start = np.where(free, np.clip(start, low, high), start)
    start = scan_focals(condensed, start, free, low, high)
    start = adjust_condensed(condensed, start, free, prior, weak)
    return adjust_focals(pairs, start, free, prior, weak, each)


def _believe(
    cameras: Sequence[Camera],
    prior: Array,
    from_exif: Array,
    free: Array,
    low: Array,
    high: Array,
    adjustment: FocalAdjustment,
    options: "CalibrateCamerasOptions",
) -> CalibratedFocals:
    """Join estimates with EXIF where both agree; believe the matches where not, if they are certain."""
    believed = list(cameras)
    sigmas = np.where(free, np.where(from_exif, options.exif_sigma, np.nan), 0.0)
    for c in np.nonzero(free)[0].tolist():
        focal = float(adjustment.focals[c])
        # distortion and principal point bias all pairs of a camera alike
        sigma = float(np.hypot(adjustment.sigmas[c], options.systematic_sigma))
        votes = options.min_votes if from_exif[c] else VOTES_WITHOUT_EXIF
        if adjustment.agreeing[c] < votes or sigma > options.max_sigma or not low[c] < focal < high[c]:
            continue
        if from_exif[c]:
            gap = abs(np.log(focal / prior[c]))
            if gap < CONTRADICTION_SIGMAS * np.hypot(sigma, options.exif_sigma):
                weight = sigma**-2 / (sigma**-2 + options.exif_sigma**-2)
                focal = float(np.exp(weight * np.log(focal) + (1.0 - weight) * np.log(prior[c])))
                sigma = float((sigma**-2 + options.exif_sigma**-2) ** -0.5)
        believed[c] = cameras[c].with_focal(focal, ESTIMATED)
        sigmas[c] = sigma
    return CalibratedFocals(believed, sigmas, adjustment.agreeing)
