"""3-cycles of a view graph and their rotation errors."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

CHUNK = 1 << 19
"""Candidate triangles that are held in memory at once."""

STORED = 1 << 22
"""Triangles up to which all are stored; beyond, every edge has a sample of its triangles."""


@dataclass(frozen=True)
class Cycles:
    """3-cycles i < j < k and the error of each.

    Parameters
    ----------
    edges : (T,3) int32, rows of the edges (i, j), (j, k) and (i, k).
    errors : (T,) float32, angle in radians of R_ik^T R_jk R_ij.
    smallest : (E,) float64, smallest error of all cycles of an edge in radians, NaN in no cycle; exact also
        where ``edges`` is a sample.
    """

    edges: Array
    errors: Array
    smallest: Array


def find_cycles(node_count: int, pairs: Array, rotations: Array, stored: int = STORED) -> Cycles:
    """Find all 3-cycles of a graph.

    Up to about ``stored`` cycles are kept. A denser graph (2,000 images all paired with each other) keeps
    a sample that depends only on the cycles themselves, at least 16 per edge on average. Memory is bounded
    by ``stored``, time by the number of cycles.

    Parameters
    ----------
    node_count : N.
    pairs : (E,2) int, edges i < j, sorted and unique.
    rotations : (E,3,3) float64, j_from_i.

    References
    ----------
    Chiba and Nishizeki, Arboricity and Subgraph Listing, 1985 (listing by the node of smaller degree).
    """
    pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    degrees = np.bincount(pairs.ravel(), minlength=node_count)
    bounds = degrees[pairs].min(axis=1) if len(pairs) else np.zeros(0, dtype=np.int64)
    per_edge = np.inf if bounds.sum() <= 3 * stored else max(16.0, 3.0 * stored / len(pairs))
    rates = np.minimum(1.0, per_edge / np.maximum(bounds, 1))
    rotations = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    smallest = np.full(len(pairs), np.inf)
    edges, errors = [np.zeros((0, 3), dtype=np.int32)], [np.zeros(0, dtype=np.float32)]
    for triangles in _triangles(pairs, degrees):
        angles = _cycle_angles(*(rotations[triangles[:, side]] for side in range(3)))
        for side in range(3):
            np.minimum.at(smallest, triangles[:, side], angles)
        if np.isfinite(per_edge):
            chosen = _uniform_of(triangles) < rates[triangles].max(axis=1)
            triangles, angles = triangles[chosen], angles[chosen]
        edges.append(triangles.astype(np.int32))
        errors.append(angles.astype(np.float32))
    return Cycles(
        np.concatenate(edges), np.concatenate(errors), np.where(np.isinf(smallest), np.nan, smallest)
    )


def smallest_of(edge_count: int, cycles: Cycles, alive: Array) -> Array:
    """Smallest error (E,) in radians over cycles of three ``alive`` (E,) bool edges, NaN in none."""
    chosen = alive[cycles.edges].all(axis=1)
    smallest = np.full(edge_count, np.inf)
    for side in range(3):
        np.minimum.at(smallest, cycles.edges[chosen, side], cycles.errors[chosen])
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


def _triangles(pairs: Array, degrees: Array) -> Iterator[Array]:
    """Triangles in chunks of (T,3) int64 edge rows (i, j), (j, k), (i, k)."""
    if len(pairs) == 0:
        return
    node_count = len(degrees)
    # each edge points to its end of larger degree, so no node has many outgoing edges
    ranks = np.empty(node_count, dtype=np.int64)
    ranks[np.lexsort((np.arange(node_count), degrees))] = np.arange(node_count)
    directed = np.sort(ranks[pairs], axis=1)
    order = np.lexsort((directed[:, 1], directed[:, 0]))
    tails, heads = directed[order].T
    keys = tails * node_count + heads
    ends = np.cumsum(np.bincount(tails, minlength=node_count))
    followers = ends[tails] - np.arange(len(tails)) - 1
    totals = np.cumsum(followers)
    start = 0
    while start < len(tails):
        done = totals[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(totals, done + CHUNK, side="right")))
        first = np.repeat(np.arange(start, stop), followers[start:stop])
        offset = np.arange(len(first)) - np.repeat(
            totals[start:stop] - followers[start:stop] - done, followers[start:stop]
        )
        second = first + 1 + offset
        wanted = heads[first] * node_count + heads[second]
        third = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        found = keys[third] == wanted
        rows = order[np.stack([first[found], second[found], third[found]], axis=1)]
        # rows in the order of sorted pairs: (i, j) < (i, k) < (j, k) for i < j < k
        rows.sort(axis=1)
        if len(rows):
            yield rows[:, [0, 2, 1]]
        start = stop


def _uniform_of(triangles: Array) -> Array:
    """A pseudo-random number in [0, 1) per triangle that depends on its edges only."""
    mixed = triangles.astype(np.uint64) @ np.array(
        [0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], dtype=np.uint64
    )
    mixed ^= mixed >> np.uint64(31)
    mixed *= np.uint64(0xD6E8FEB86659FD93)
    return (mixed >> np.uint64(11)) * 2.0**-53


def _cycle_angles(r01: Array, r12: Array, r02: Array) -> Array:
    """Angles (T,) in radians of R02^T R12 R01, exact near zero."""
    # the Frobenius norm of a difference of rotations is sqrt(8) sin(angle / 2)
    differences = (r12 @ r01 - r02).reshape(-1, 9)
    chords = np.sqrt(np.einsum("ta,ta->t", differences, differences) / 8.0)
    angles: Array = 2.0 * np.arcsin(np.minimum(chords, 1.0))
    return angles
