"""RANSAC over pairs of observations, batched over tracks of one length."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import offsets_of
from snakesfm.triangulation.interface import TriangulationLimits, TriangulationProblem, check_points

BATCH_VALUES = 4_000_000
REFINEMENTS = 4


def triangulate_ransac_dlt(
    problem: TriangulationProblem, limits: TriangulationLimits
) -> tuple[Array, Array]:
    """Midpoints of pairs of rays, scored on all observations; then DLT and Gauss-Newton over the inliers.

    The scheme of GTSfM, with a truncated squared error (MSAC) as score. All pairs are tried where there are
    no more than ``max_hypotheses``, else a seeded choice that depends on the length of the track alone.

    Source: Baid et al., Distributed Global Structure-from-Motion with a Deep Front-End, arXiv 2311.18801;
    DLT in Hartley and Zisserman, Multiple View Geometry, section 12.2; MSAC in Torr and Zisserman, MLESAC,
    CVIU 2000.
    """
    lengths = np.diff(problem.offsets)
    points = np.full((len(lengths), 3), np.nan)
    for length in np.unique(lengths[lengths >= 2]).tolist():
        tracks = np.nonzero(lengths == length)[0]
        pairs = hypotheses_of(length, limits)
        step = max(1, BATCH_VALUES // (len(pairs) * length * 3))
        for start in range(0, len(tracks), step):
            chunk = tracks[start : start + step]
            rows = problem.offsets[chunk][:, None] + np.arange(length)
            points[chunk] = _triangulate_batch(problem, rows, pairs, limits)
    return check_points(problem, points, limits)


def hypotheses_of(length: int, limits: TriangulationLimits) -> Array:
    """Pairs (H,2) of the observations of a track, in lexicographic order."""
    total = length * (length - 1) // 2
    rows = np.arange(total)
    if total > limits.max_hypotheses:
        rng = np.random.default_rng((limits.seed, length))
        rows = np.sort(rng.choice(total, limits.max_hypotheses, replace=False))
    # the list of all pairs would grow with the square of the length, of each length that occurs
    starts = offsets_of(np.arange(length - 1, 0, -1))
    first = np.searchsorted(starts, rows, side="right") - 1
    return np.stack([first, rows - starts[first] + first + 1], axis=1)


def _triangulate_batch(
    problem: TriangulationProblem, rows: Array, pairs: Array, limits: TriangulationLimits
) -> Array:
    """Points (B,3) of tracks of one length, given the rows (B,V) of their observations."""
    images = problem.image_ids[rows]
    rotations, translations = problem.rotations[images], problem.translations[images]
    rays = problem.rays[rows]
    threshold = limits.max_reprojection_error_px / problem.focals_px[images]
    centers = -np.einsum("bvji,bvj->bvi", rotations, translations)
    rays_3d = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
    directions = np.einsum("bvji,bvj->bvi", rotations, rays_3d)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    hypotheses = _midpoints(centers, directions, pairs)
    scores = _scores(hypotheses, rotations, translations, rays, threshold)
    best = np.argmin(scores, axis=1)
    points = np.take_along_axis(hypotheses, best[:, None, None], axis=1)[:, 0]
    least = np.take_along_axis(scores, best[:, None], axis=1)[:, 0]
    for attempt in range(REFINEMENTS):
        inliers = _residuals(points, rotations, translations, rays)[1] <= threshold
        refine = _linear if attempt == 0 else _gauss_newton
        refined = refine(points, rotations, translations, rays, inliers)
        score = _scores(refined[:, None], rotations, translations, rays, threshold)[:, 0]
        better = score < least
        points = np.where(better[:, None], refined, points)
        least = np.where(better, score, least)
    return points


def _midpoints(centers: Array, directions: Array, pairs: Array) -> Array:
    """Points (B,H,3) nearest to both rays of each pair; NaN where they are parallel or meet behind."""
    first, second = directions[:, pairs[:, 0]], directions[:, pairs[:, 1]]
    baseline = centers[:, pairs[:, 1]] - centers[:, pairs[:, 0]]
    cosine = np.sum(first * second, axis=-1)
    along_first = np.sum(baseline * first, axis=-1)
    along_second = np.sum(baseline * second, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (1.0 - cosine**2)
        depth_first = (along_first - cosine * along_second) * scale
        depth_second = (cosine * along_first - along_second) * scale
        points = 0.5 * (
            centers[:, pairs[:, 0]]
            + depth_first[..., None] * first
            + centers[:, pairs[:, 1]]
            + depth_second[..., None] * second
        )
    ahead = (depth_first > 0) & (depth_second > 0) & np.isfinite(scale)
    return np.where(ahead[..., None], points, np.nan)


def _residuals(
    points: Array, rotations: Array, translations: Array, rays: Array
) -> tuple[Array, Array, Array]:
    """Camera-frame points (B,V,3), errors (B,V) on z = 1 (inf behind the camera), offsets (B,V,2)."""
    in_camera = np.einsum("bvij,bj->bvi", rotations, points) + translations
    with np.errstate(divide="ignore", invalid="ignore"):
        offsets = in_camera[..., :2] / in_camera[..., 2:] - rays
    errors = np.hypot(offsets[..., 0], offsets[..., 1])
    return in_camera, np.where(in_camera[..., 2] > 0, errors, np.inf), offsets


def _scores(
    hypotheses: Array, rotations: Array, translations: Array, rays: Array, threshold: Array
) -> Array:
    """MSAC scores (B,H): sum of squared errors over the threshold, at most one each; inf where invalid."""
    projected = np.einsum("bvij,bhj->bhvi", rotations, hypotheses) + translations[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        offsets = projected[..., :2] / projected[..., 2:] - rays[:, None]
        squares = np.sum(offsets**2, axis=-1) / (threshold**2)[:, None]
    squares = np.where(projected[..., 2] > 0, np.minimum(squares, 1.0), 1.0)
    scores = squares.sum(axis=-1)
    return np.where(np.isfinite(scores), scores, np.inf)


def _linear(points: Array, rotations: Array, translations: Array, rays: Array, inliers: Array) -> Array:
    """Linear least squares (B,3) of the inliers' projection equations, inverse depths as weights."""
    in_camera = np.einsum("bvij,bj->bvi", rotations, points) + translations
    weights = np.where(inliers, 1.0 / np.where(inliers, in_camera[..., 2], 1.0), 0.0)[..., None]
    rows = (rotations[..., :2, :] - rays[..., None] * rotations[..., 2:, :]) * weights[..., None]
    right = (rays * translations[..., 2:] - translations[..., :2]) * weights
    return _solve(
        np.einsum("bvki,bvkj->bij", rows, rows), np.einsum("bvki,bvk->bi", rows, right), fallback=points
    )


def _gauss_newton(
    points: Array, rotations: Array, translations: Array, rays: Array, inliers: Array
) -> Array:
    """One step (B,3) on the squared reprojection errors of the inliers."""
    in_camera, _, offsets = _residuals(points, rotations, translations, rays)
    depths = np.where(inliers, in_camera[..., 2], 1.0)[..., None, None]
    projected = np.where(inliers[..., None], offsets + rays, 0.0)
    jacobian = (rotations[..., :2, :] - projected[..., None] * rotations[..., 2:, :]) / depths
    jacobian = np.where(inliers[..., None, None], jacobian, 0.0)
    offsets = np.where(inliers[..., None], offsets, 0.0)
    step = _solve(
        np.einsum("bvki,bvkj->bij", jacobian, jacobian),
        -np.einsum("bvki,bvk->bi", jacobian, offsets),
        fallback=np.zeros_like(points),
    )
    return points + step


def _solve(matrices: Array, vectors: Array, fallback: Array) -> Array:
    """Solutions (B,3) of symmetric systems; ``fallback`` where one is singular."""
    scale = np.trace(matrices, axis1=1, axis2=2)
    safe = np.isfinite(scale) & (scale > 0)
    scaled = np.where(safe[:, None, None], matrices / np.where(safe, scale, 1.0)[:, None, None], np.eye(3))
    safe &= np.abs(np.linalg.det(scaled)) > 1e-14
    scaled = np.where(safe[:, None, None], scaled, np.eye(3))
    right = np.where(safe[:, None], vectors / np.where(safe, scale, 1.0)[:, None], 0.0)
    return np.where(safe[:, None], np.linalg.solve(scaled, right[..., None])[..., 0], fallback)
