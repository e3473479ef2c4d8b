"""The two-view geometry of one pair of images."""

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import angle_between, log_so3
from snakesfm.two_view.bundle import inverse_depths
from snakesfm.two_view.correspondences import correspond, unique_matches
from snakesfm.two_view.covariance import DIRECTION_UNKNOWN_VARIANCE
from snakesfm.two_view.estimators import ESTIMATORS, RobustPose
from snakesfm.two_view.kinds import fit_homography, fit_rotation, planar_twins, transfer_errors_px
from snakesfm.two_view.refinement import SIGMA_FLOOR_PX, RefinedPose, descend_sampson, refine_pose
from snakesfm.two_view.sampson import Correspondences, cauchy_cost, sampson_errors_px
from snakesfm.two_view.significance import expected_by_chance, significance_of

if TYPE_CHECKING:
    from snakesfm.config.estimate_two_view import EstimateTwoViewOptions

THRESHOLD_SIGMAS = 3.0
SELECTION_SIGMAS = 4.0
REACH_FACTOR = 4.0
HOPELESS_SHARE = 0.6
# squared, in standard deviations of the pose with a direction
MAX_BEND_SQUARED = 16.0
# from fewer inliers, which five parameters chose and fit, the covariance of a pose comes out too small
SURE_INLIERS = 50
TWIN_PLANE_RATIO = 0.4
TWIN_START_RATIO = 0.5
TWIN_INLIER_RATIO = 0.85
TWIN_NOISE_FLOOR_PX = 0.1
TWIN_ROTATION_COS = float(np.cos(np.radians(5.0)))
TWIN_DIRECTION_COS = float(np.cos(np.radians(15.0)))


@dataclass(frozen=True)
class TwoViewEstimate:
    """Relative pose of a pair, its certainty, and the matches that agree with it.

    Parameters
    ----------
    rotation, translation : (3,3) and unit (3,) float64, j_from_i; NaN where there is none.
    covariance : (5,5) float64 in rad^2: left rotation increment, then the two tangents of
        ``tangents.tangent_basis(translation)``; NaN where there is no pose.
    inliers : (K,2) int32, keypoint rows in image i and j, one to one; where several keypoints lie at one
        place the first of them stands for all.
    kind : general, planar or rotation_only.
    rejection : empty if accepted, else why not: too_few_matches, estimation_failed, too_few_inliers,
        low_inlier_ratio, not_significant, indeterminate, ambiguous.
    match_count : matches between distinct places whose rays are finite.
    inlier_ratio : share of inliers among them.
    triangulation_angle_deg : median angle between the inliers' rays.
    significance : minus log10 of the number of false alarms, 0 where there is no pose.
    sigma_px : robust standard deviation of the inliers' Sampson errors, NaN where there is no pose.
    """

    rotation: Array
    translation: Array
    covariance: Array
    inliers: Array
    kind: str
    rejection: str
    match_count: int
    inlier_ratio: float
    triangulation_angle_deg: float
    significance: float
    sigma_px: float


def estimate_two_view_geometry(
    keypoints_i: Array,
    keypoints_j: Array,
    matches: Array,
    camera_i: Camera,
    camera_j: Camera,
    options: "EstimateTwoViewOptions",
    seed: int,
) -> TwoViewEstimate:
    """Estimate, refine and judge the relative pose of two images.

    Parameters
    ----------
    keypoints_i, keypoints_j : (N,2) float32 in detector pixels as the cameras, all of each image.
    matches : (M,2) int32, keypoint rows in image i and in image j, between distinct places
        (``correspondences.unify_matches``), the most confident first.
    seed : the only source of randomness.
    """
    points = correspond(keypoints_i, keypoints_j, matches, camera_i, camera_j)
    # strong distortion cannot be undone everywhere
    finite: Array = np.isfinite(np.hstack([points.rays_i, points.rays_j])).all(axis=1)
    matches, points = matches[finite], points.take(finite)
    if len(matches) < options.min_inliers:
        return _without_pose("too_few_matches", len(matches))
    extent = np.ptp(keypoints_j[matches[:, 1]], axis=0)
    robust = ESTIMATORS[options.estimator](points, options.max_error_px, options.max_iterations, seed)
    if robust is None:
        return _without_pose("estimation_failed", len(matches))
    if _is_hopeless(points, robust, options):
        return _without_pose("too_few_inliers", len(matches))
    refined, significance = _estimate(points, extent, robust, options, seed)
    return _judge(points, matches, extent, refined, significance, options, seed)


def _without_pose(rejection: str, match_count: int) -> TwoViewEstimate:
    return TwoViewEstimate(
        rotation=np.full((3, 3), np.nan),
        translation=np.full(3, np.nan),
        covariance=np.full((5, 5), np.nan),
        inliers=np.zeros((0, 2), dtype=np.int32),
        kind="general",
        rejection=rejection,
        match_count=match_count,
        inlier_ratio=0.0,
        triangulation_angle_deg=0.0,
        significance=0.0,
        sigma_px=float("nan"),
    )


def _is_hopeless(points: Correspondences, robust: RobustPose, options: "EstimateTwoViewOptions") -> bool:
    """Whether so few matches are near a first pose that refining it would not make the pair acceptable."""
    count = len(points)
    needed = max(
        options.min_inliers, options.min_inlier_ratio * count, (options.min_support * count) ** 0.5
    )
    errors = sampson_errors_px(points, robust.rotation, robust.translation)
    return bool(np.count_nonzero(np.abs(errors) < options.inlier_error_px) < HOPELESS_SHARE * needed)


def _estimate(
    points: Correspondences, extent: Array, robust: RobustPose, options: "EstimateTwoViewOptions", seed: int
) -> tuple[RefinedPose, float]:
    """The best of a tight estimation and, where the matches are noisier, of one adapted to their noise."""
    best = _refined(points, extent, robust, options.max_error_px, options)
    adapted = min(THRESHOLD_SIGMAS * best[0].sigma_px, options.max_adapted_error_px)
    if options.adapt_error and adapted > 1.5 * options.max_error_px:
        other = ESTIMATORS[options.estimator](points, adapted, options.max_iterations, seed)
        if other is not None:
            best = max(best, _refined(points, extent, other, adapted, options), key=lambda found: found[1])
    return best


def _refined(
    points: Correspondences,
    extent: Array,
    robust: RobustPose,
    max_error_px: float,
    options: "EstimateTwoViewOptions",
) -> tuple[RefinedPose, float]:
    """A robust pose, refined, and the significance of that."""
    refined = refine_pose(
        points,
        robust.rotation,
        robust.translation,
        options.refine,
        REACH_FACTOR * max_error_px,
        options.loss_scale,
    )
    return refined, significance_of(refined.errors_px, float(extent[0]), float(extent[1]))


def _judge(
    points: Correspondences,
    matches: Array,
    extent: Array,
    refined: RefinedPose,
    significance: float,
    options: "EstimateTwoViewOptions",
    seed: int,
) -> TwoViewEstimate:
    selection_px = max(options.inlier_error_px, SELECTION_SIGMAS * refined.sigma_px)
    agrees = np.abs(refined.errors_px) < selection_px
    agrees &= _in_front(points, refined.rotation, refined.translation, refined.sigma_px)
    rows = unique_matches(matches, refined.errors_px, agrees)
    inliers = points.take(rows)
    ratio = len(rows) / len(matches)
    angles = angle_between(inliers.rays_i @ refined.rotation.T, inliers.rays_j)
    angle_deg = float(np.degrees(np.median(angles))) if len(rows) else 0.0

    kind, rotation, covariance = "general", refined.rotation, refined.covariance
    rejection = ""
    if len(rows) < options.min_inliers:
        rejection = "too_few_inliers"
    elif ratio < options.min_inlier_ratio:
        rejection = "low_inlier_ratio"
    elif significance < options.min_significance or len(rows) * ratio < options.min_support:
        rejection = "not_significant"
    else:
        alone = None
        if angle_deg < options.rotation_only_angle_deg:
            alone = _rotation_alone(points, matches, rows, refined, selection_px, options)
        if alone is not None:
            kind, ambiguous = "rotation_only", False
            rotation, of_rotation = alone
            covariance = np.eye(5) * DIRECTION_UNKNOWN_VARIANCE
            covariance[:3, :3] = of_rotation
        else:
            own_px = refined.errors_px[rows]
            kind, ambiguous = _kind_of(inliers, own_px, extent, refined, selection_px, options, seed)
        worst = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if worst > np.radians(options.max_rotation_std_deg):
            rejection = "indeterminate"
        elif ambiguous:
            rejection = "ambiguous"
    return TwoViewEstimate(
        rotation=rotation,
        translation=refined.translation,
        covariance=covariance,
        inliers=matches[rows][np.lexsort(matches[rows].T[::-1])],
        kind=kind,
        rejection=rejection,
        match_count=len(matches),
        inlier_ratio=ratio,
        triangulation_angle_deg=angle_deg,
        significance=significance,
        sigma_px=refined.sigma_px,
    )


def _in_front(points: Correspondences, rotation: Array, translation: Array, sigma_px: float) -> Array:
    """Mask (M,) of points in front of both cameras, or too far to tell."""
    near = inverse_depths(points, rotation, translation)
    depth_j = (points.rays_i @ rotation.T)[:, 2] + near * translation[2]
    unclear = points.mean_focal * np.abs(near) < SELECTION_SIGMAS * sigma_px
    mask: Array = ((near > 0) & (depth_j > 0)) | unclear
    return mask


def _agreeing(
    points: Correspondences, pose: tuple[Array, Array], sigma_px: float, max_error_px: float
) -> int:
    """How many points are within ``max_error_px`` of a pose and in front of it."""
    close = np.abs(sampson_errors_px(points, *pose)) < max_error_px
    return int(np.count_nonzero(close & _in_front(points, *pose, sigma_px)))


def _same_pose(refined: RefinedPose, pose: tuple[Array, Array]) -> bool:
    rotation_cos = 0.5 * (float(np.sum(pose[0] * refined.rotation)) - 1.0)
    direction_cos = float(pose[1] @ refined.translation)
    return rotation_cos > TWIN_ROTATION_COS and direction_cos > TWIN_DIRECTION_COS


def _rotation_alone(
    points: Correspondences,
    matches: Array,
    inliers: Array,
    refined: RefinedPose,
    selection_px: float,
    options: "EstimateTwoViewOptions",
) -> tuple[Array, Array] | None:
    """Rotation (3,3) and its covariance (3,3) in rad^2 if it explains the inliers alone, else None.

    Parallax bends a rotation alone, far beyond its covariance. It must agree with the pose with a direction
    under the covariance of that, and what their difference exceeds chance by is added to its own.
    """
    first, _ = fit_rotation(points.take(inliers), refined.rotation, SIGMA_FLOOR_PX)
    errors = np.linalg.norm(transfer_errors_px(points, first), axis=1)
    if np.count_nonzero(errors[inliers] < selection_px) < options.planar_ratio * len(inliers):
        return None
    # inliers of the pose with a direction lie one way along their epipolar lines, and mismatches far along
    rows = unique_matches(matches, errors, errors < selection_px)
    rotation, covariance = fit_rotation(points.take(rows), first, SIGMA_FLOOR_PX)
    bend = log_so3(rotation @ refined.rotation.T)
    squared = float(bend @ np.linalg.solve(refined.covariance[:3, :3], bend))
    if squared > MAX_BEND_SQUARED * max(1.0, SURE_INLIERS / len(inliers)) ** 2:
        return None
    # by chance the square is as large as there are coordinates
    excess = max(1.0 - len(bend) / max(squared, 1e-12), 0.0)
    return rotation, covariance + excess * np.outer(bend, bend)


def _kind_of(
    inliers: Correspondences,
    own_px: Array,
    extent: Array,
    refined: RefinedPose,
    selection_px: float,
    options: "EstimateTwoViewOptions",
    seed: int,
) -> tuple[str, bool]:
    """Whether the pair is planar or general, and whether another pose explains its one plane as well."""
    H, explained = fit_homography(inliers, selection_px, seed)
    kind = "planar" if explained >= options.planar_ratio * len(inliers) else "general"
    if options.min_ambiguity_gap == 0 or explained < TWIN_PLANE_RATIO * len(inliers):
        return kind, False
    by_chance = expected_by_chance(refined.errors_px, float(extent[0]), float(extent[1]), selection_px)
    gaps = [_gap_to(inliers, own_px, by_chance, refined, twin, selection_px) for twin in planar_twins(H)]
    return kind, min(gaps, default=np.inf) < options.min_ambiguity_gap


def _gap_to(
    inliers: Correspondences,
    own_px: Array,
    by_chance: float,
    refined: RefinedPose,
    twin: tuple[Array, Array],
    selection_px: float,
) -> float:
    """Log-likelihood of the inliers lost by another pose than theirs, whose errors are ``own_px``.

    Infinite if the other is no rival.
    As many inliers as are expected ``by_chance``, rounded up, are left out, those farthest from the rival:
    a mismatch that happens to lie on the own pose's epipolar line may be far from the rival's, and alone
    would decide.
    """
    scale = 2.0 * max(refined.sigma_px, TWIN_NOISE_FLOOR_PX)
    if _same_pose(refined, twin):
        return float("inf")
    if _agreeing(inliers, twin, refined.sigma_px, 3.0 * selection_px) < TWIN_START_RATIO * len(inliers):
        return float("inf")
    start = descend_sampson(inliers, *twin, max(scale, selection_px))
    rival = descend_sampson(inliers, *start, scale)
    if _same_pose(refined, rival):
        return float("inf")
    if _agreeing(inliers, rival, refined.sigma_px, selection_px) < TWIN_INLIER_RATIO * len(inliers):
        return float("inf")
    others = sampson_errors_px(inliers, *rival)
    told = np.argsort(np.abs(others), kind="stable")[: max(len(inliers) - ceil(by_chance), 0)]
    return 2.0 * (cauchy_cost(others[told], scale) - cauchy_cost(own_px[told], scale))
