"""Initial centres: baseline ratios of edges from shared landmarks, then linear least squares.

After Cui and Tan, "Global Structure-from-Motion by Similarity Averaging" (ICCV 2015): the two cameras of an
edge see a landmark at a depth that is known up to the edge's baseline; two edges that share a camera and a
landmark so compare their baselines. Nothing is drawn at random and nothing is non-convex but the weights.
"""

from dataclasses import replace

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.sparse_systems import solve_spd
from snakesfm.grouping import components_of, offsets_of, sum_by
from snakesfm.translation_averaging.clusters import join_by_edges
from snakesfm.translation_averaging.problem import PositioningProblem
from snakesfm.view_graph.components import label_components

FIRST_SCALE = 16.0
IRLS_ROUNDS = 12
IRLS_TOLERANCE = 5e-3
# more take memory and time with the square of the tracks' length, and tell nothing new of an edge
MANY_SHARED_RAYS = 1_000_000
ENOUGH_SHARED_RAYS = 25


def shared_rays(problem: PositioningProblem) -> tuple[Array, Array, Array]:
    """Every landmark that both cameras of an edge see: edge (S), ray rows in images i (S) and j (S).

    Of more than ``MANY_SHARED_RAYS``, as where all images see the same, each edge has some, evenly chosen.
    """
    count = problem.image_count
    _, lengths = np.unique(problem.ray_tracks, return_counts=True)
    starts = offsets_of(lengths)[:-1]
    row_length = np.repeat(lengths, lengths)
    position = np.arange(len(problem.ray_tracks)) - np.repeat(starts, lengths)
    keys = problem.pairs[:, 0] * count + problem.pairs[:, 1]
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    empty = np.zeros(0, dtype=np.int64)
    edges, lefts, rights = [empty], [empty], [empty]
    for gap in range(1, int(lengths.max(initial=1)) if len(keys) else 1):
        left = np.flatnonzero(position + gap < row_length)
        right = left + gap
        key = problem.ray_images[left] * count + problem.ray_images[right]
        at = np.minimum(np.searchsorted(ordered, key), len(keys) - 1)
        found = ordered[at] == key
        edges.append(order[at[found]])
        lefts.append(left[found])
        rights.append(right[found])
    edge, left, right = (np.concatenate(parts) for parts in (edges, lefts, rights))
    kept = _thinned(edge, len(keys))
    return edge[kept], left[kept], right[kept]


def _thinned(edges: Array, count: int) -> Array | slice:
    """Which shared rays of the edges (S) to use: all, or some of each edge where they are many."""
    if len(edges) <= MANY_SHARED_RAYS:
        return slice(None)
    enough = max(ENOUGH_SHARED_RAYS, MANY_SHARED_RAYS // count)
    sizes = np.bincount(edges, minlength=count)
    order = np.argsort(edges, kind="stable")
    rank = np.empty(len(edges), np.int64)
    rank[order] = np.arange(len(edges)) - np.repeat(offsets_of(sizes)[:-1], sizes)
    return np.flatnonzero(rank % -(-sizes[edges] // enough) == 0)


def refine_directions(
    problem: PositioningProblem,
    edges: Array,
    left: Array,
    right: Array,
    scale_rad: float,
    rounds: int = 8,
) -> tuple[Array, Array]:
    """Directions of the edges (E,3) from the rays that they share, and how many rays (E) agree.

    The pair's own direction was estimated with the pair's own rotation; given the averaged rotations the
    epipolar constraint d . (v_i x v_j) = 0 is linear in d. Robust: Cauchy weights whose scale shrinks to
    ``scale_rad``, started at the pair's direction, which stays where fewer than eight rays agree.
    """
    normals = np.cross(problem.rays[left], problem.rays[right])
    sines = np.linalg.norm(normals, axis=1)
    count = len(problem.pairs)
    directions = problem.directions.copy()
    usable = sines > 1e-3
    for step in range(rounds):
        scale = scale_rad * max(FIRST_SCALE * 0.5**step, 1.0)
        miss = epipolar_rad(problem, directions, edges, left, right)
        weights = usable / (1.0 + (miss / scale) ** 2)
        moments = sum_by(
            normals[:, :, None] * normals[:, None, :] * (weights / np.maximum(sines, 1e-3))[:, None, None],
            edges,
            count,
        )
        agree = np.bincount(edges, weights=(miss < 2.0 * scale) & usable, minlength=count)
        enough = agree >= 8
        vectors = np.linalg.eigh(moments[enough])[1][:, :, 0]
        vectors *= np.where(np.sum(vectors * directions[enough], axis=1) < 0, -1.0, 1.0)[:, None]
        directions[enough] = vectors
    # The pair's own direction decides the sign unless most landmarks would then lie behind the cameras.
    turned = directions[edges]
    sides = [np.einsum("si,si->s", np.cross(turned, problem.rays[end]), normals) for end in (right, left)]
    ahead = np.logical_and(sides[0] > 0, sides[1] > 0)
    behind = np.logical_and(sides[0] < 0, sides[1] < 0)
    votes = np.bincount(edges, weights=weights * (ahead * 1.0 - behind * 1.0), minlength=count)
    return np.where((votes < 0)[:, None], -directions, directions), agree


def epipolar_rad(
    problem: PositioningProblem, directions: Array, edges: Array, left: Array, right: Array
) -> Array:
    """Smallest angle (S) by which one of the two rays must turn to meet the other."""
    d = directions[edges]
    a, b = problem.rays[left], problem.rays[right]
    volume = np.abs(np.einsum("si,si->s", d, np.cross(a, b)))
    plane = np.maximum(np.linalg.norm(np.cross(d, a), axis=1), np.linalg.norm(np.cross(d, b), axis=1))
    return np.asarray(np.arcsin(np.minimum(volume / np.maximum(plane, 1e-9), 1.0)))


def chain_centers(
    problem: PositioningProblem,
    scale_rad: float,
    max_relative_sigma: float,
    edges_per_camera: int = 8,
) -> tuple[Array, Array]:
    """Centres (N,3) from the baselines of the edges; NaN where an image hangs on no edge that has one.

    Parts whose baselines no landmark compares with those of the largest are joined to it by their edges.
    Also which images (N,) bool are in parts that this does not join: of those no scale is known.

    Parameters
    ----------
    problem : with rays.
    scale_rad : angle at which a ray is held to be half wrong.
    max_relative_sigma : of the centres of a part that edges join, see :func:`join_by_edges`.
    edges_per_camera : the best edges of each camera, by parallax of the rays that agree, take part.
    """
    edges, left, right = shared_rays(problem)
    directions, _ = refine_directions(problem, edges, left, right, scale_rad)
    d = directions[edges]
    a, b = problem.rays[left], problem.rays[right]
    normals = np.cross(a, b)
    sine = np.maximum(np.linalg.norm(normals, axis=1), 1e-9)
    # Signed depths by the law of sines: baseline : depth_i : depth_j = sin(a,b) : sin(d,b) : sin(d,a).
    depth_i = np.einsum("si,si->s", np.cross(d, b), normals) / sine**2
    depth_j = np.einsum("si,si->s", np.cross(d, a), normals) / sine**2
    miss = epipolar_rad(problem, directions, edges, left, right)
    good = (depth_i > 0) & (depth_j > 0) & (miss < 3.0 * scale_rad) & (sine > 2.0 * scale_rad)
    edges, left, right, sine = edges[good], left[good], right[good], sine[good]
    depth_i, depth_j = depth_i[good], depth_j[good]
    information = np.minimum(sine / scale_rad, 20.0) ** 2
    strength = np.bincount(edges, weights=information, minlength=len(problem.pairs))
    taken = _strongest(problem.pairs, strength, problem.image_count, edges_per_camera)
    keep = taken[edges]
    rows = np.concatenate([left[keep], right[keep]])
    depths = np.log(np.concatenate([depth_i[keep], depth_j[keep]]))
    edges, information = np.tile(edges[keep], 2), np.tile(information[keep], 2)
    firmness = np.sqrt(strength)
    found = []
    for part in _comparable_parts(edges, rows, len(problem.pairs), len(problem.rays)):
        baselines = _log_baselines(
            edges[part], rows[part], depths[part], information[part], len(problem.pairs)
        )
        linked = np.flatnonzero(taken & np.isfinite(baselines))
        found.append(_link(problem, directions, np.exp(baselines), firmness, linked))
    apart = np.zeros(problem.image_count, dtype=bool)
    if not found:
        return np.full((problem.image_count, 3), np.nan), apart
    centers, others = join_by_edges(replace(problem, directions=directions), found, max_relative_sigma)
    for cluster in others:
        apart |= np.isfinite(cluster[:, 0]) & ~np.isfinite(centers[:, 0])
    return centers, apart


def _comparable_parts(edges: Array, rows: Array, edge_count: int, row_count: int) -> list[Array]:
    """Depths, by their places, of edges whose baselines can be compared; the part with most edges first.

    Parameters
    ----------
    edges, rows : (S,) edge and ray of each depth. A ray that one edge alone sees compares nothing.
    """
    several = np.flatnonzero(np.bincount(rows, minlength=row_count)[rows] > 1)
    if not len(several):
        return []
    ends = np.column_stack([edges[several], edge_count + rows[several]])
    labels = components_of(edge_count + row_count, ends)
    sizes = np.bincount(labels[np.unique(edges[several])])
    by_label = several[np.argsort(labels[edges[several]], kind="stable")]
    parts = np.split(by_label, np.flatnonzero(np.diff(labels[edges[by_label]])) + 1)
    return sorted(parts, key=lambda part: -sizes[labels[edges[part[0]]]])


def _strongest(pairs: Array, strength: Array, image_count: int, edges_per_camera: int) -> Array:
    """Mask (E) of the strongest edges of each camera, of those with any strength."""
    ends = np.concatenate([pairs[:, 0], pairs[:, 1]])
    rows = np.tile(np.arange(len(pairs)), 2)
    order = np.lexsort((rows, -strength[rows], ends))
    starts = np.searchsorted(ends[order], np.arange(image_count))
    rank = np.arange(len(order)) - starts[ends[order]]
    taken = np.zeros(len(pairs), dtype=bool)
    taken[rows[order[rank < edges_per_camera]]] = True
    return np.asarray(taken & (strength > 0))


def _log_baselines(edges: Array, rows: Array, log_depths: Array, weights: Array, edge_count: int) -> Array:
    """Logarithms (E) of the baselines of edges that can be compared, up to one constant; NaN elsewhere.

    A ray row has one depth: log_depth + log_baseline(edge) must agree over the edges that see it. L1 by
    reweighting; the depths are eliminated, so the system is a graph Laplacian over the edges.
    """
    from scipy.sparse import csc_matrix, csr_matrix, diags

    result = np.full(edge_count, np.nan)
    names, column = np.unique(edges, return_inverse=True)
    row = np.unique(rows, return_inverse=True)[1]
    values, base = log_depths, weights
    unknown = np.zeros(len(names))
    robust = np.ones(len(values))
    for _ in range(IRLS_ROUNDS):
        before = unknown
        w = base * robust
        shape = (int(row.max()) + 1, len(names))
        per_row = np.bincount(row, weights=w)
        incidence = csr_matrix((w, (row, column)), shape=shape)
        mean_incidence = diags(1.0 / per_row) @ incidence
        laplacian = diags(np.bincount(column, weights=w)) - incidence.T @ mean_incidence
        mean_value = np.bincount(row, weights=w * values) / per_row
        right = np.bincount(column, weights=w * (mean_value[row] - values))
        matrix = csc_matrix(laplacian + diags(1e-9 * laplacian.diagonal()))
        unknown = solve_spd(matrix, right[:, None])[:, 0]
        if np.abs(unknown - before).max() < IRLS_TOLERANCE:
            break
        total = values + unknown[column]
        depth = np.bincount(row, weights=w * total) / per_row
        residual = np.abs(total - depth[row]) * np.sqrt(base)
        robust = 1.0 / np.maximum(residual, 0.5)
    result[names] = unknown - np.median(unknown)
    return result


def _link(
    problem: PositioningProblem, directions: Array, baselines: Array, strength: Array, taken: Array
) -> Array:
    """Centres (N,3) that differ by the edges' vectors, robustly; NaN off the largest connected part."""
    from scipy.sparse import coo_matrix, diags

    count = problem.image_count
    centers = np.full((count, 3), np.nan)
    if len(taken) == 0:
        return centers
    main = label_components(count, problem.pairs[taken]) == 0
    taken = taken[main[problem.pairs[taken, 0]]]
    names, ends = np.unique(problem.pairs[taken], return_inverse=True)
    ends = ends.reshape(-1, 2)
    vectors = directions[taken] * baselines[taken, None]
    base = np.minimum(strength[taken], 100.0) ** 2 / baselines[taken] ** 2
    robust = np.ones(len(taken))
    place = np.zeros((len(names), 3))
    for _ in range(15):
        w = base * robust
        links = coo_matrix((w, (ends[:, 0], ends[:, 1])), shape=(len(names),) * 2)
        links = links + links.T
        degree = np.asarray(links.sum(axis=1)).ravel()
        matrix = (diags(degree * (1.0 + 1e-10)) - links).tocsc()
        right = np.zeros((len(names), 3))
        np.add.at(right, ends[:, 1], vectors * w[:, None])
        np.add.at(right, ends[:, 0], -vectors * w[:, None])
        place = solve_spd(matrix, right)
        gap = place[ends[:, 1]] - place[ends[:, 0]] - vectors
        relative = np.linalg.norm(gap, axis=1) / baselines[taken]
        robust = 1.0 / np.maximum(relative, 0.01)
    centers[names] = place - np.median(place, axis=0)
    return centers
