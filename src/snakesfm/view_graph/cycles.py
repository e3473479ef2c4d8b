"""3-cycles of a view graph and their rotation errors."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array

CHUNK = 1 << 19
"""Candidate cycles that are held in memory at once."""

TRIED_PER_EDGE = 64
"""Third images that are tried per edge: all of them where one end has no more neighbours."""

FEWEST_TRIED_PER_EDGE = 8
"""The same in large dense graphs."""

TRIED = 1 << 20
"""Candidates up to which ``TRIED_PER_EDGE`` are tried."""


@dataclass(frozen=True)
class Cycles:
    """3-cycles i < j < k and the error of each.

    Parameters
    ----------
    edges : (T,3) int32, rows of the edges (i, j), (j, k) and (i, k).
    errors : (T,) float32, angle in radians of R_ik^T R_jk R_ij.
    smallest : (E,) float64, smallest error of an edge's cycles in radians, NaN in no cycle.
    per_edge : how many cycles an edge of the graph is in on average, those that were not tried included.
    """

    edges: Array
    errors: Array
    smallest: Array
    per_edge: float


def find_cycles(
    node_count: int, pairs: Array, rotations: Array, tried_per_edge: int = TRIED_PER_EDGE
) -> Cycles:
    """Find the 3-cycles of a graph, or enough of them where it is dense.

    Every edge looks for cycles among the neighbours of its end of smaller degree: all of them up to
    ``tried_per_edge``, else as many, drawn evenly and depending on the edge alone. A graph with more
    edges than fit ``TRIED`` candidates makes do with fewer per edge, so time is about linear in the edges.

    Parameters
    ----------
    node_count : N.
    pairs : (E,2) int, edges i < j, sorted and unique.
    rotations : (E,3,3) float64, j_from_i.
    """
    pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    rotations = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    edge_count = len(pairs)
    sample = int(
        np.clip(TRIED // max(edge_count, 1), min(FEWEST_TRIED_PER_EDGE, tried_per_edge), tried_per_edge)
    )
    keys, total = [np.zeros(0, dtype=np.int64)], 0.0
    for found, estimate in _candidates(node_count, pairs, sample):
        keys.append(found)
        total += estimate
    distinct = np.unique(np.concatenate(keys))
    edges = np.empty((len(distinct), 3), dtype=np.int32)
    errors = np.empty(len(distinct), dtype=np.float32)
    flat = pairs[:, 0] * node_count + pairs[:, 1]
    for start in range(0, len(distinct), CHUNK):
        # a cycle's key is the row of its edge (i, j) and the image k
        first, last = np.divmod(distinct[start : start + CHUNK], max(node_count, 1))
        second = np.searchsorted(flat, pairs[first, 1] * node_count + last)
        third = np.searchsorted(flat, pairs[first, 0] * node_count + last)
        rows = slice(start, start + len(first))
        edges[rows] = np.stack([first, second, third], axis=1)
        errors[rows] = _cycle_angles(rotations[first], rotations[second], rotations[third])
    return Cycles(edges, errors, _smallest(edge_count, edges, errors), total / max(edge_count, 1))


def smallest_of(edge_count: int, cycles: Cycles, alive: Array) -> Array:
    """Smallest error (E,) in radians over cycles of three ``alive`` (E,) bool edges, NaN in none."""
    chosen = alive[cycles.edges].all(axis=1)
    return _smallest(edge_count, cycles.edges[chosen], cycles.errors[chosen])


def _smallest(edge_count: int, edges: Array, errors: Array) -> Array:
    smallest = np.full(edge_count, np.inf)
    for side in range(3):
        np.minimum.at(smallest, edges[:, side], errors)
    return np.where(np.isinf(smallest), np.nan, smallest)


def median_of(edge_count: int, cycles: Cycles, alive: Array) -> Array:
    """Median error (E,) in radians over cycles of three ``alive`` (E,) bool edges, NaN in none."""
    chosen = alive[cycles.edges].all(axis=1)
    owners = cycles.edges[chosen].ravel()
    # one sort by edge, then error: an error is at most pi, so multiples of 4 keep edges apart
    keys = np.sort(4.0 * owners + np.repeat(cycles.errors[chosen], 3))
    counts = np.bincount(owners, minlength=edge_count)
    ends = np.cumsum(counts)
    medians = np.full(edge_count, np.nan)
    some = counts > 0
    lower = (ends - counts + (counts - 1) // 2)[some]
    upper = (ends - counts + counts // 2)[some]
    medians[some] = 0.5 * (keys[lower] + keys[upper]) - 4.0 * np.flatnonzero(some)
    return medians


def _candidates(node_count: int, pairs: Array, sample: int) -> Iterator[tuple[Array, float]]:
    """Keys (T,) int64 of 3-cycles i < j < k in chunks: row of edge (i, j) times ``node_count``, plus k.

    Also about how many cycles the edges of the chunk are in, by the share that closed of those tried.
    """
    if len(pairs) == 0:
        return
    heads, tails = pairs.T
    ends = np.concatenate([heads, tails])
    order = np.lexsort((np.concatenate([tails, heads]), ends))
    neighbours = np.concatenate([tails, heads])[order]
    degrees = np.bincount(ends, minlength=node_count)
    offsets = np.cumsum(degrees) - degrees
    flat = heads * node_count + tails
    swapped = degrees[heads] > degrees[tails]
    near, far = np.where(swapped, tails, heads), np.where(swapped, heads, tails)
    rows_per_chunk = max(1, CHUNK // sample)
    for start in range(0, len(pairs), rows_per_chunk):
        rows = np.arange(start, min(start + rows_per_chunk, len(pairs)))
        available = degrees[near[rows]]
        counts = np.minimum(available, sample)
        row = np.repeat(rows, counts)
        step = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
        # evenly spaced neighbours from a place of the edge's own
        spread = (step * np.repeat(available, counts)) // np.repeat(counts, counts)
        place = (spread + row * 0x9E3779B1) % np.repeat(available, counts)
        place = np.where(np.repeat(available, counts) > sample, place, step)
        third = neighbours[offsets[near[row]] + place]
        wanted = np.minimum(far[row], third) * node_count + np.maximum(far[row], third)
        found = np.minimum(np.searchsorted(flat, wanted), len(flat) - 1)
        closed = (flat[found] == wanted) & (third != far[row])
        nodes = np.sort(np.stack([near[row], far[row], third], axis=1)[closed], axis=1)
        keys = np.searchsorted(flat, nodes[:, 0] * node_count + nodes[:, 1]) * node_count + nodes[:, 2]
        yield keys, float((available / counts) @ np.bincount(row[closed] - start, minlength=len(rows)))


def _cycle_angles(r01: Array, r12: Array, r02: Array) -> Array:
    """Angles (T,) in radians of R02^T R12 R01, exact near zero."""
    # the Frobenius norm of a difference of rotations is sqrt(8) sin(angle / 2)
    differences = (r12 @ r01 - r02).reshape(-1, 9)
    chords = np.sqrt(np.einsum("ta,ta->t", differences, differences) / 8.0)
    angles: Array = 2.0 * np.arcsin(np.minimum(chords, 1.0))
    return angles
