"""Bundle adjustment of centres and landmarks with known rotations, on the angles of the rays."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.sparse_systems import solve_spd
from snakesfm.grouping import sum_by
from snakesfm.translation_averaging.landmarks import locate_landmarks, perpendicular
from snakesfm.translation_averaging.problem import PositioningProblem

FACTORED_UNKNOWNS = 900
"""Unknowns up to which the reduced system, which is denser than a graph's, is factored."""

CG_TOLERANCE = 1e-4

RAYS_PER_LANDMARK = 64
"""Rays beyond which a landmark is cut: the blocks that it fills grow with their square."""

PAIRS_AT_ONCE = 1_000_000
"""Products of two rays of one landmark that are held at once."""

# of an edge, that of a ray being one
EDGE_WEIGHT = 0.1
MOST_STEPS = 20
# with ever larger damping, until one lowers the cost
MOST_TRIALS = 6


@dataclass(frozen=True)
class _Linearized:
    """Residual directions of all rays and edges at one state, and what depends on them alone."""

    ray_units: Array
    ray_lengths: Array
    ray_misses: Array
    edge_units: Array
    edge_lengths: Array
    edge_misses: Array


@dataclass(frozen=True)
class _Structure:
    """Which 3x3 blocks the reduced camera system has; the same in every step."""

    first: Array
    second: Array
    groups: Array
    rows: Array
    columns: Array


@dataclass(frozen=True)
class _Layout:
    """Edges and rays by the rows of the cameras (n) and landmarks (m) that are unknown.

    Parameters
    ----------
    problem : its rays are sorted by landmark and, within one, by image.
    ends : (E,2) cameras of the edges.
    cameras, landmarks : (Q,) of the rays.
    structure : which blocks of the reduced camera system they fill.
    """

    problem: PositioningProblem
    ends: Array
    cameras: Array
    landmarks: Array
    structure: _Structure


def refine_angles(problem: PositioningProblem, centers: Array, scale_rad: float) -> tuple[Array, Array]:
    """Centres (N,3) and landmarks (max track + 1, 3) that fit the rays and edges best, from a first guess.

    Levenberg-Marquardt with the landmarks eliminated (Schur complement); the residual of a ray is the chord
    between it and the direction to its landmark, under a Cauchy loss whose scale shrinks to ``scale_rad``.
    Images without a first guess stay NaN and their rays and edges are not used. The gauge is left to the
    damping: the result is in the frame and near the scale of the first guess. A landmark of very many rays
    is cut into several, each seen from all over, which share its first guess; the first one is returned.

    Parameters
    ----------
    problem : edges and rays in the frame of the rotations.
    centers : (N,3) first guess, NaN where there is none.
    scale_rad : scale of the Cauchy loss of a ray, and the least one of an edge, whose own is its standard
        deviation; both begin eight times as large.

    Returns
    -------
    Centres (N,3), and landmarks (max track + 1, 3), NaN where a track has no ray that is used.

    Source: Triggs et al., Bundle adjustment: a modern synthesis, section 6.1, for the elimination; the
    chord as residual is that of 1DSfM (Wilson and Snavely, ECCV 2014).
    """
    known = np.isfinite(centers[:, 0])
    problem = problem.select_edges(known[problem.pairs[:, 0]] & known[problem.pairs[:, 1]]).select_rays(
        known[problem.ray_images]
    )
    points = locate_landmarks(problem, centers)
    problem = problem.select_rays(np.isfinite(points[problem.ray_tracks, 0]))
    images = problem.images()
    problem, owners = _cut_landmarks(problem)
    place, spots = _descend(_layout(problem, images), centers[images], points[owners], scale_rad)
    result = np.full_like(centers, np.nan)
    result[images] = place
    landmarks = np.full_like(points, np.nan)
    landmarks[owners[::-1]] = spots[::-1]
    return result, landmarks


def _descend(layout: _Layout, place: Array, spots: Array, scale_rad: float) -> tuple[Array, Array]:
    """Centres (n,3) and landmarks (m,3) of least cost, from a first guess."""
    sigmas = np.maximum(layout.problem.sigmas_rad, scale_rad)
    damping = 1e-4
    state = _linearize(layout, place, spots)
    stage = 8.0
    for _ in range(MOST_STEPS):
        ray_scale = scale_rad * stage
        edge_scale = sigmas * stage
        cost = _cost(state, ray_scale, edge_scale)
        ray_w = 1.0 / (ray_scale**2 + state.ray_misses**2)
        edge_w = EDGE_WEIGHT / (edge_scale**2 + state.edge_misses**2)
        improved = False
        for _ in range(MOST_TRIALS):
            step, move = _step(layout, state, ray_w, edge_w, damping)
            trial = _linearize(layout, place + step, spots + move)
            trial_cost = _cost(trial, ray_scale, edge_scale)
            if trial_cost < cost:
                improved = True
                break
            damping *= 8.0
        if improved:
            place, spots, state = place + step, spots + move, trial
            damping = max(damping / 5.0, 1e-9)
        if stage > 1.0:
            stage = max(stage / 2.0, 1.0)
        elif not improved or cost - trial_cost < 1e-4 * cost:
            break
    return place, spots


def _cut_landmarks(problem: PositioningProblem) -> tuple[PositioningProblem, Array]:
    """The rays by landmarks, from 0 on, of at most ``RAYS_PER_LANDMARK``, and the track (m) of each."""
    problem, tracks = problem.number_tracks()
    row = problem.ray_tracks
    lengths = np.bincount(row, minlength=len(tracks))
    position = np.arange(len(row)) - (np.cumsum(lengths) - lengths)[row]
    pieces = -(-lengths // RAYS_PER_LANDMARK)
    # Every n-th ray of a track: neighbouring images would see a landmark from one side.
    piece = (np.cumsum(pieces) - pieces)[row] + position % pieces[row]
    order = np.argsort(piece, kind="stable")
    problem = problem.select_rays(order)
    return replace(problem, ray_tracks=piece[order]), np.repeat(tracks, pieces)


def _linearize(layout: _Layout, place: Array, spots: Array) -> _Linearized:
    problem, ends = layout.problem, layout.ends
    offsets = spots[layout.landmarks] - place[layout.cameras]
    ray_lengths = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    ray_units = offsets / ray_lengths[:, None]
    baselines = place[ends[:, 1]] - place[ends[:, 0]]
    edge_lengths = np.maximum(np.linalg.norm(baselines, axis=1), 1e-9)
    edge_units = baselines / edge_lengths[:, None]
    return _Linearized(
        ray_units,
        ray_lengths,
        np.linalg.norm(ray_units - problem.rays, axis=1),
        edge_units,
        edge_lengths,
        np.linalg.norm(edge_units - problem.directions, axis=1),
    )


def _cost(state: _Linearized, ray_scale: float, edge_scale: Array) -> float:
    rays = np.log1p((state.ray_misses / ray_scale) ** 2).sum()
    edges = np.log1p((state.edge_misses / edge_scale) ** 2).sum()
    return float(rays + EDGE_WEIGHT * edges)


def _layout(problem: PositioningProblem, images: Array) -> _Layout:
    """The edges and rays of a problem whose cameras (n) are those of ``images``."""
    column = np.full(problem.image_count, -1)
    column[images] = np.arange(len(images))
    ends, cameras = column[problem.pairs], column[problem.ray_images]
    structure = _structure(cameras, problem.ray_tracks, ends)
    return _Layout(problem, ends, cameras, problem.ray_tracks, structure)


def _structure(ray_column: Array, track_row: Array, ends: Array) -> _Structure:
    """Rays of one landmark in pairs ``first <= second``, and the upper blocks that they and edges fill."""
    lengths = np.bincount(track_row)
    stops = np.cumsum(lengths)[track_row]
    per_ray = stops - np.arange(len(track_row))
    first = np.repeat(np.arange(len(track_row)), per_ray)
    second = first + np.arange(len(first)) - np.repeat(np.cumsum(per_ray) - per_ray, per_ray)
    cameras = int(max(ends.max(initial=-1), ray_column.max(initial=-1))) + 1
    # Within a landmark the rays are sorted by camera, so these blocks lie on or above the diagonal.
    row = np.concatenate([ray_column[first], ends.min(axis=1), np.arange(cameras)])
    column = np.concatenate([ray_column[second], ends.max(axis=1), np.arange(cameras)])
    keys, groups = np.unique(row * cameras + column, return_inverse=True)
    return _Structure(first, second, groups, keys // cameras, keys % cameras)


def _step(
    layout: _Layout, state: _Linearized, ray_w: Array, edge_w: Array, damping: float
) -> tuple[Array, Array]:
    """Damped Gauss-Newton steps of the cameras (n,3) and of the landmarks (m,3)."""
    problem, ends, ray_column, track_row = layout.problem, layout.ends, layout.cameras, layout.landmarks
    cameras, landmarks = int(ends.max(initial=-1)) + 1, int(track_row.max(initial=-1)) + 1
    cameras = max(cameras, int(ray_column.max(initial=-1)) + 1)
    ray_h = perpendicular(state.ray_units) * (ray_w / state.ray_lengths**2)[:, None, None]
    along = np.einsum("qi,qi->q", state.ray_units, problem.rays)
    ray_g = (problem.rays - state.ray_units * along[:, None]) * (ray_w / state.ray_lengths)[:, None]
    edge_h = perpendicular(state.edge_units) * (edge_w / state.edge_lengths**2)[:, None, None]
    along = np.einsum("ei,ei->e", state.edge_units, problem.directions)
    edge_g = (problem.directions - state.edge_units * along[:, None]) * (edge_w / state.edge_lengths)[
        :, None
    ]

    camera_h = (
        sum_by(ray_h, ray_column, cameras)
        + sum_by(edge_h, ends[:, 0], cameras)
        + sum_by(edge_h, ends[:, 1], cameras)
    )
    camera_g = (
        -sum_by(ray_g, ray_column, cameras)
        - sum_by(edge_g, ends[:, 0], cameras)
        + sum_by(edge_g, ends[:, 1], cameras)
    )
    camera_h += np.eye(3) * (damping * np.trace(camera_h, axis1=1, axis2=2) + 1e-12)[:, None, None]
    point_h = sum_by(ray_h, track_row, landmarks)
    point_h += np.eye(3) * (damping * np.trace(point_h, axis1=1, axis2=2) + 1e-12)[:, None, None]
    point_g = sum_by(ray_g, track_row, landmarks)
    inverse = np.linalg.inv(point_h)

    gain = ray_h @ inverse[track_row]
    reduced_g = camera_g + sum_by(np.einsum("qij,qj->qi", gain, point_g[track_row]), ray_column, cameras)
    matrix = _symmetric(layout.structure, _blocks(layout.structure, gain, ray_h, edge_h, camera_h), cameras)
    delta = solve_spd(matrix, reduced_g.reshape(-1, 1), 3, FACTORED_UNKNOWNS, CG_TOLERANCE).reshape(-1, 3)
    pull = sum_by(np.einsum("qij,qj->qi", ray_h, delta[ray_column]), track_row, landmarks)
    move = np.einsum("pij,pj->pi", inverse, point_g + pull)
    return delta, move


def _symmetric(structure: _Structure, blocks: Array, cameras: int) -> Any:
    """The sparse matrix (3n,3n) of which the upper blocks (B,3,3) are given."""
    from scipy.sparse import coo_matrix

    off = structure.rows != structure.columns
    blocks = np.concatenate([blocks, blocks[off].transpose(0, 2, 1)])
    row = np.concatenate([structure.rows, structure.columns[off]])
    column = np.concatenate([structure.columns, structure.rows[off]])
    shape = (len(blocks), 3, 3)
    rows = np.broadcast_to(3 * row[:, None, None] + np.arange(3)[:, None], shape)
    columns = np.broadcast_to(3 * column[:, None, None] + np.arange(3), shape)
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * cameras,) * 2).tocsc()


def _blocks(structure: _Structure, gain: Array, ray_h: Array, edge_h: Array, camera_h: Array) -> Array:
    """Upper blocks (B,3,3) of the reduced camera system."""
    pairs = len(structure.first)
    blocks = np.zeros((len(structure.rows), 3, 3))
    for start in range(0, pairs, PAIRS_AT_ONCE):
        part = slice(start, min(start + PAIRS_AT_ONCE, pairs))
        products = gain[structure.first[part]] @ ray_h[structure.second[part]]
        blocks -= sum_by(products, structure.groups[part], len(blocks))
    edges = structure.groups[pairs : pairs + len(edge_h)]
    # a pair of images has one edge, so no place is met twice
    blocks[edges] -= edge_h
    blocks[structure.groups[pairs + len(edge_h) :]] += camera_h
    return blocks
