"""Joint refinement of focal lengths over many two-view problems, with the relative poses eliminated."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from snakesfm.arrays import Array
from snakesfm.calibration.condensed import (
    NOISE_FLOOR_PX,
    CondensedPairs,
    EssentialFit,
    fit_essential,
    reduced_equations,
)
from snakesfm.calibration.epipolar import EpipolarPair, cameras_of
from snakesfm.geometry.robust import robust_sigma
from snakesfm.two_view.refinement import descend_from
from snakesfm.two_view.sampson import (
    Correspondences,
    cauchy_weights,
    sampson_errors_px,
    sampson_jacobian,
)

ITERATIONS = 15
# from focal lengths that condensed pairs agree on
FINAL_ITERATIONS = 3
PAIR_SIGMA = 0.02
AGREEMENT = 2.0
LOG_STEP = 1e-4
SMALL_LOG_STEP = 1e-3
MIN_STRENGTH = 2.0
MAX_LOG_STEP = 0.25
COLUMNS_AT_ONCE = 256
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
    """

    focals: Array
    sigmas: Array
    agreeing: Array


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
    poses = list(each(lambda pair: pose_of(pair, focals), pairs))

    def linearise(focals: Array) -> tuple[Array, Array]:
        found = list(each(partial(_linearised, focals=focals), zip(pairs, poses, strict=True)))
        poses[:] = [pose for pose, _, _ in found]
        h = np.array([h for _, h, _ in found]).reshape(-1, 2, 2)
        return h, np.array([b for _, _, b in found]).reshape(-1, 2)

    cameras, held = cameras_of(pairs), ~np.asarray(free, dtype=bool)
    found = _solve(cameras, linearise, focals, held, prior, prior_sigma, FINAL_ITERATIONS)
    strengths = np.sqrt(np.max(np.diagonal(found.h, axis1=1, axis2=2), axis=1))
    agrees = (found.distances < 2.0 * AGREEMENT) & (strengths > MIN_STRENGTH)
    first, second = cameras[agrees].T
    agreeing = np.bincount(first, minlength=len(focals))
    agreeing += np.bincount(second[first != second], minlength=len(focals))
    sigmas = np.sqrt(inverse_diagonal(found.information)) * ~held
    return FocalAdjustment(np.exp(found.logs), sigmas, agreeing.astype(np.int32))


def inverse_diagonal(matrix: Any) -> Array:
    """Diagonal (C,) of the inverse of a sparse matrix, whose columns are not all held at once."""
    count = matrix.shape[0]
    factor = splu(matrix.tocsc())
    diagonal = np.empty(count)
    for start in range(0, count, COLUMNS_AT_ONCE):
        rows = np.arange(start, min(start + COLUMNS_AT_ONCE, count))
        units = np.zeros((count, len(rows)))
        units[rows, rows - start] = 1.0
        diagonal[rows] = factor.solve(units)[rows, rows - start]
    return diagonal


def adjust_condensed(
    pairs: CondensedPairs, focals: Array, free: Array, prior: Array, prior_sigma: Array
) -> Array:
    """As :func:`adjust_focals` on condensed pairs: the focal lengths (C,) alone."""
    fit: EssentialFit | None = None

    def linearise(focals: Array) -> tuple[Array, Array]:
        nonlocal fit
        units = focals[pairs.cameras] / pairs.scales[:, None]
        fit = fit_essential(pairs, units[:, None], fit, 2 if fit is None else 1)
        return reduced_equations(units, fit)

    held = ~np.asarray(free, dtype=bool)
    found = _solve(pairs.cameras, linearise, focals, held, prior, prior_sigma, ITERATIONS)
    return np.asarray(np.exp(found.logs))


@dataclass(frozen=True)
class _Solution:
    """Log focal lengths (C,), and the equations of their last step: all, and each pair's ``h`` (P,2,2).

    ``distances`` (P,) are the lengths of the pairs' own steps in sigmas.
    """

    logs: Array
    information: Any
    h: Array
    distances: Array


def _solve(
    cameras: Array,
    linearise: Callable[[Array], tuple[Array, Array]],
    focals: Array,
    held: Array,
    prior: Array,
    prior_sigma: Array,
    iterations: int,
) -> _Solution:
    """Iterate on the equations (P,2,2), (P,2) of ``cameras`` (P,2) that ``linearise`` gives."""
    count = len(focals)
    logs, prior_logs = np.log(np.asarray(focals, dtype=np.float64)), np.log(prior)
    rows, columns = np.repeat(cameras, 2, axis=1).ravel(), np.tile(cameras, 2).ravel()
    trust = prior_sigma**-2.0
    own = diags_array(np.where(held, 1.0, trust), format="csc")
    for _ in range(iterations):
        h, b, distances = _capped(*_in_cameras(*linearise(np.exp(logs)), cameras, held))
        weights = 1.0 / (1.0 + (distances / AGREEMENT) ** 2)
        values = (weights[:, None, None] * h).ravel()
        H = coo_array((values, (rows, columns)), shape=(count, count)).tocsc() + own
        g = (logs - prior_logs) * trust
        g += np.bincount(cameras.ravel(), (weights[:, None] * b).ravel(), minlength=count)
        g[held] = 0.0
        step = np.clip(-splu(H).solve(g), -MAX_LOG_STEP, MAX_LOG_STEP)
        logs = logs + step
        if np.max(np.abs(step), initial=0.0) < SMALL_LOG_STEP:
            break
    return _Solution(logs, H, h, distances)


def _in_cameras(h: Array, b: Array, cameras: Array, held: Array) -> tuple[Array, Array]:
    """Equations of pairs in their two focal lengths, in one where both are the same, none held."""
    free = ~held[cameras]
    h = h * free[:, :, None] * free[:, None, :]
    b = b * free
    same = cameras[:, 0] == cameras[:, 1]
    first = np.array([1.0, 0.0])
    h[same] = h[same].sum(axis=(1, 2))[:, None, None] * np.outer(first, first)
    b[same] = b[same].sum(axis=1)[:, None] * first
    return h, b


def _capped(h: Array, b: Array) -> tuple[Array, Array, Array]:
    """Equations (P,2,2), (P,2) with a systematic error, and lengths (P,) of the pairs' own steps in sigmas.

    A pair is never trusted beyond a relative standard deviation of 2 %, for lens distortion and an offset
    principal point bias all of its points alike.
    """
    # covariance of the two plus a systematic part, inverted: h (1 + s^2 h)^-1
    shrink = np.linalg.inv(np.eye(2) + PAIR_SIGMA**2 * h)
    h, b = h @ shrink, (shrink.transpose(0, 2, 1) @ b[..., None])[..., 0]
    h = 0.5 * (h + h.transpose(0, 2, 1))
    own = np.linalg.solve(h + 1e-9 * np.eye(2), b[..., None])
    squares = (own.transpose(0, 2, 1) @ h @ own)[:, 0, 0]
    return h, b, np.sqrt(np.maximum(squares, 0.0))


def correspondences_of(pair: EpipolarPair, focal_i: float, focal_j: float) -> Correspondences:
    """The pair's points as rays.

    Parameters
    ----------
    pair : its M points are pixels from each principal point.
    focal_i, focal_j : focal lengths in pixels.

    Returns
    -------
    M correspondences on the plane z = 1 of each camera's frame.
    """
    one = np.ones(len(pair.points_i))
    return Correspondences(
        np.column_stack([pair.points_i / focal_i, one]),
        np.column_stack([pair.points_j / focal_j, one]),
        focal_i,
        focal_j,
    )


def pose_of(pair: EpipolarPair, focals: Array) -> tuple[Array, Array]:
    """The relative pose of the essential matrix nearest to F with some focal lengths.

    Of its four poses, the one that has most of the points in front of both cameras.

    Parameters
    ----------
    pair : with the fundamental matrix.
    focals : (C,) focal lengths of all cameras in pixels.

    Returns
    -------
    Rotation (3,3) and unit translation (3,), j_from_i.
    """
    focal_i, focal_j = float(focals[pair.camera_i]), float(focals[pair.camera_j])
    E = np.diag([focal_j, focal_j, 1.0]) @ pair.F @ np.diag([focal_i, focal_i, 1.0])
    some = slice(None, None, max(1, -(-len(pair.points_i) // POINTS_IN_FRONT)))
    _, rotation, translation, _ = cv2.recoverPose(
        E, pair.points_i[some] / focal_i, pair.points_j[some] / focal_j, np.eye(3)
    )
    return rotation, translation.ravel()


def refined_pose(pair: EpipolarPair, pose: tuple[Array, Array], focals: Array) -> tuple[Array, Array]:
    """The best relative pose for some focal lengths, from a nearby one.

    That of least Cauchy loss of the Sampson error, with a scale of one pixel of the mean focal length.

    Parameters
    ----------
    pair : whose points the pose fits.
    pose : rotation (3,3) and unit translation (3,), j_from_i, to start from.
    focals : (C,) focal lengths of all cameras in pixels.

    Returns
    -------
    Rotation (3,3) and unit translation (3,), j_from_i.
    """
    focal_i, focal_j = float(focals[pair.camera_i]), float(focals[pair.camera_j])
    mean = 0.5 * (focal_i + focal_j)
    points_i, points_j = pair.points_i * (mean / focal_i), pair.points_j * (mean / focal_j)
    return descend_from(pose, points_i, points_j, mean, 1.0)


def _linearised(
    start: tuple[EpipolarPair, tuple[Array, Array]], focals: Array
) -> tuple[tuple[Array, Array], Array, Array]:
    """The best pose of a pair from a nearby one, and what :func:`_reduced` gives there."""
    pair, pose = start
    pose = refined_pose(pair, pose, focals)
    return pose, *_reduced(pair, pose, focals)


def _reduced(pair: EpipolarPair, pose: tuple[Array, Array], focals: Array) -> tuple[Array, Array]:
    """Normal equations (2,2), (2,) of the log focals without the pose, by the noise of the points."""
    focal_i, focal_j = float(focals[pair.camera_i]), float(focals[pair.camera_j])
    errors, by_pose = sampson_jacobian(correspondences_of(pair, focal_i, focal_j), *pose)
    sigma = robust_sigma(errors, NOISE_FLOOR_PX)
    weights = cauchy_weights(errors, 2.0 * sigma) / sigma**2
    up = np.exp(LOG_STEP)
    by_focal = np.column_stack(
        [
            sampson_errors_px(correspondences_of(pair, focal_i * a, focal_j * b), *pose)
            - sampson_errors_px(correspondences_of(pair, focal_i / a, focal_j / b), *pose)
            for a, b in ((up, 1.0), (1.0, up))
        ]
    ) / (2.0 * LOG_STEP)
    A = by_pose.T @ (weights[:, None] * by_pose)
    A += 1e-9 * np.trace(A) * np.eye(5)
    B = by_pose.T @ (weights[:, None] * by_focal)
    solved = np.linalg.solve(A, np.column_stack([B, by_pose.T @ (weights * errors)]))
    h = by_focal.T @ (weights[:, None] * by_focal) - B.T @ solved[:, :2]
    return h, by_focal.T @ (weights * errors) - B.T @ solved[:, 2]
