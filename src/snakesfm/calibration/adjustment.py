"""Joint refinement of focal lengths over many two-view problems, with the relative poses eliminated."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import poselib
from numpy.typing import NDArray

from snakesfm.calibration.epipolar import EpipolarPair
from snakesfm.two_view.estimators import poselib_camera
from snakesfm.two_view.sampson import (
    Correspondences,
    cauchy_weights,
    robust_sigma_px,
    sampson_errors_px,
    sampson_jacobian,
)

Array = NDArray[Any]
ITERATIONS = 15
NOISE_FLOOR_PX = 0.2
PAIR_SIGMA = 0.02
AGREEMENT = 2.0
LOG_STEP = 1e-4
MIN_STRENGTH = 2.0
MAX_LOG_STEP = 0.25
# at most so many points tell which of four poses has them in front of both cameras
POINTS_IN_FRONT = 50
# like the builtin map; that of a pool works on several items at a time
Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


@dataclass(frozen=True)
class FocalAdjustment:
    """Adjusted focal lengths.

    Parameters
    ----------
    focals : (C,) pixels.
    sigmas : (C,) relative standard deviations, of the prior and all agreeing pairs; 0 where held.
    agreeing : (C,) int, pairs that agree with the result and constrain it.
    disagreement : median over pairs of how far each is from its own best focal lengths, in its own sigmas.
    """

    focals: Array
    sigmas: Array
    agreeing: Array
    disagreement: float


def adjust_focals(
    pairs: Sequence[EpipolarPair],
    focals: Array,
    free: Array,
    prior: Array,
    prior_sigma: Array,
    each: Each = map,
) -> FocalAdjustment:
    """Refine focal lengths (C,) so that the Sampson errors of all pairs are smallest.

    Parameters
    ----------
    pairs : usable pairs.
    focals : (C,) start values in pixels.
    free : (C,) bool, whose focal length is adjusted.
    prior, prior_sigma : (C,) focal lengths and their relative standard deviations.
    each : applies a function to all pairs.

    Each pair has its own relative pose, eliminated from its 5 + 2 parameters by a Schur complement, and
    tells the focal lengths as well as its geometry allows: pairs that cannot tell (forward motion, fixation
    on one point) have little weight by themselves. A pair that contradicts the others is weighted down.
    """
    count = len(focals)
    logs, prior_logs = np.log(np.asarray(focals, dtype=np.float64)), np.log(prior)
    poses = list(each(lambda pair: pose_of(pair, focals), pairs))
    held = ~np.asarray(free, dtype=bool)
    information, strengths = np.zeros((count, count)), np.zeros((len(pairs), 2))
    for _ in range(ITERATIONS):
        H, g = np.diag(prior_sigma**-2.0), (logs - prior_logs) * prior_sigma**-2.0
        linearise = partial(_linearised, focals=np.exp(logs), held=held)
        found = list(each(linearise, zip(pairs, poses, strict=True)))
        poses = [pose for pose, _ in found]
        for row, (pair, (_, (h, b, distance))) in enumerate(zip(pairs, found, strict=True)):
            weight = 1.0 / (1.0 + (distance / AGREEMENT) ** 2)
            strengths[row] = distance, np.sqrt(np.max(np.diag(h)))
            ends = [pair.camera_i, pair.camera_j]
            np.add.at(H, np.ix_(ends, ends), weight * h)
            np.add.at(g, ends, weight * b)
        H[held] = 0.0
        H[:, held] = 0.0
        H[held, held] = 1.0
        g[held] = 0.0
        information = H
        step = np.clip(-np.linalg.solve(H, g), -MAX_LOG_STEP, MAX_LOG_STEP)
        logs = logs + step
        if np.max(np.abs(step), initial=0.0) < 1e-4:
            break
    agreeing = np.zeros(count, dtype=np.int32)
    for row, pair in enumerate(pairs):
        if strengths[row, 0] < 2.0 * AGREEMENT and strengths[row, 1] > MIN_STRENGTH:
            for camera in {pair.camera_i, pair.camera_j}:
                agreeing[camera] += 1
    sigmas = np.sqrt(np.diag(np.linalg.inv(information))) * ~held
    disagreement = float(np.median(strengths[:, 0])) if len(pairs) else 0.0
    return FocalAdjustment(np.exp(logs), sigmas, agreeing, disagreement)


def correspondences_of(pair: EpipolarPair, focal_i: float, focal_j: float) -> Correspondences:
    """The pair's points as rays, for these focal lengths."""
    one = np.ones(len(pair.points_i))
    return Correspondences(
        np.column_stack([pair.points_i / focal_i, one]),
        np.column_stack([pair.points_j / focal_j, one]),
        focal_i,
        focal_j,
    )


def pose_of(pair: EpipolarPair, focals: Array) -> tuple[Array, Array]:
    """The relative pose of the essential matrix nearest to F with these focal lengths."""
    focal_i, focal_j = float(focals[pair.camera_i]), float(focals[pair.camera_j])
    E = np.diag([focal_j, focal_j, 1.0]) @ pair.F @ np.diag([focal_i, focal_i, 1.0])
    some = slice(None, None, max(1, -(-len(pair.points_i) // POINTS_IN_FRONT)))
    _, rotation, translation, _ = cv2.recoverPose(
        E, pair.points_i[some] / focal_i, pair.points_j[some] / focal_j, np.eye(3)
    )
    return rotation, translation.ravel()


def refined_pose(pair: EpipolarPair, pose: tuple[Array, Array], focals: Array) -> tuple[Array, Array]:
    """The best relative pose for these focal lengths, from a nearby one."""
    focal_i, focal_j = float(focals[pair.camera_i]), float(focals[pair.camera_j])
    mean = 0.5 * (focal_i + focal_j)
    start = poselib.CameraPose()
    start.R, start.t = pose
    found, _ = poselib.refine_relative_pose(
        pair.points_i * (mean / focal_i),
        pair.points_j * (mean / focal_j),
        start,
        poselib_camera(mean),
        poselib_camera(mean),
        {"loss_type": "CAUCHY", "loss_scale": 1.0, "max_iterations": 20},
    )
    length = float(np.linalg.norm(found.t))
    if not np.isfinite(length) or length < 1e-12:
        return pose
    return np.asarray(found.R), np.asarray(found.t) / length


def _linearised(
    start: tuple[EpipolarPair, tuple[Array, Array]], focals: Array, held: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array, float]]:
    """The best pose of a pair from a nearby one, and what :func:`_reduced` gives there."""
    pair, pose = start
    pose = refined_pose(pair, pose, focals)
    return pose, _reduced(pair, pose, focals, held)


def _reduced(
    pair: EpipolarPair, pose: tuple[Array, Array], focals: Array, held: Array
) -> tuple[Array, Array, float]:
    """Normal equations (2,2), (2,) of the log focals without the pose; length of the pair's own step.

    The noise of the points is measured; a pair is never trusted beyond a relative standard deviation of
    2 %, for lens distortion and an offset principal point bias all of its points alike.
    """
    focal_i, focal_j = float(focals[pair.camera_i]), float(focals[pair.camera_j])
    errors, by_pose = sampson_jacobian(correspondences_of(pair, focal_i, focal_j), *pose)
    sigma = robust_sigma_px(errors, NOISE_FLOOR_PX)
    weights = cauchy_weights(errors, 2.0 * sigma) / sigma**2
    up, down = np.exp(LOG_STEP), np.exp(-LOG_STEP)
    by_focal = np.column_stack(
        [
            sampson_errors_px(correspondences_of(pair, focal_i * a, focal_j * b), *pose)
            - sampson_errors_px(correspondences_of(pair, focal_i / a, focal_j / b), *pose)
            for a, b in ((up, 1.0), (1.0, up))
        ]
    ) / (np.log(up) - np.log(down))
    if pair.camera_i == pair.camera_j:
        by_focal = np.column_stack([by_focal.sum(axis=1), np.zeros(len(errors))])
    by_focal = by_focal * ~held[[pair.camera_i, pair.camera_j]]
    A = by_pose.T @ (weights[:, None] * by_pose)
    A += 1e-9 * np.trace(A) * np.eye(5)
    B = by_pose.T @ (weights[:, None] * by_focal)
    solved = np.linalg.solve(A, np.column_stack([B, by_pose.T @ (weights * errors)]))
    h = by_focal.T @ (weights[:, None] * by_focal) - B.T @ solved[:, :2]
    b = by_focal.T @ (weights * errors) - B.T @ solved[:, 2]
    # covariance of the two plus a systematic part, inverted: h (1 + s^2 h)^-1
    shrink = np.linalg.inv(np.eye(2) + PAIR_SIGMA**2 * h)
    h, b = h @ shrink, shrink.T @ b
    own = np.linalg.lstsq(h + 1e-9 * np.eye(2), b, rcond=None)[0]
    return 0.5 * (h + h.T), b, float(np.sqrt(max(own @ h @ own, 0.0)))
