"""The choice of image pairs: all, neighbours in order, similar ones, or listed by the user."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from snakesfm.arrays import Array
from snakesfm.image_names import natural_key

HELD_BYTES = 1 << 29

REASONS = ("exhaustive", "sequential", "retrieved", "listed", "spatial")


@dataclass(frozen=True)
class PairTable:
    """Pairs of images with the reasons why they were chosen.

    Parameters
    ----------
    pairs : (P,2) int64 rows (i, j) with i < j, sorted and distinct.
    reasons : (P,) uint8, bit k is set where ``REASONS[k]`` applies.
    similarities : (P,) float32, NaN where not computed.
    """

    pairs: Array
    reasons: Array
    similarities: Array

    @classmethod
    def of(cls, pairs: Array, reason: str, similarities: Array | None = None) -> "PairTable":
        """Pairs (P,2) in any order, even twice or as (j, i); pairs of an image with itself are left out."""
        pairs = np.sort(np.asarray(pairs, dtype=np.int64).reshape(-1, 2), axis=1)
        if similarities is None:
            similarities = np.full(len(pairs), np.nan, np.float32)
        proper = pairs[:, 0] < pairs[:, 1]
        distinct, first = np.unique(pairs[proper], axis=0, return_index=True)
        bit = np.uint8(1 << REASONS.index(reason))
        return cls(distinct, np.full(len(distinct), bit), similarities[proper][first])

    def union(self, other: "PairTable") -> "PairTable":
        """Pairs of either table; reasons are joined and the similarity that is known is kept."""
        stacked = np.concatenate([self.pairs, other.pairs])
        pairs, inverse = np.unique(stacked, axis=0, return_inverse=True)
        reasons = np.zeros(len(pairs), np.uint8)
        np.bitwise_or.at(reasons, inverse.ravel(), np.concatenate([self.reasons, other.reasons]))
        similarities = np.full(len(pairs), np.nan, np.float32)
        known = np.concatenate([self.similarities, other.similarities])
        there = ~np.isnan(known)
        similarities[inverse.ravel()[there]] = known[there]
        return PairTable(pairs, reasons, similarities)

    def take(self, rows: Array) -> "PairTable":
        """Some of the pairs."""
        return PairTable(self.pairs[rows], self.reasons[rows], self.similarities[rows])

    def reason_texts(self) -> list[str]:
        """The reasons of each pair, joined by '+'."""
        texts = [
            "+".join(name for bit, name in enumerate(REASONS) if code >> bit & 1)
            for code in range(1 << len(REASONS))
        ]
        return [texts[code] for code in self.reasons]


def exhaustive_pairs(count: int) -> PairTable:
    """All pairs of ``count`` images."""
    return PairTable.of(np.column_stack(np.triu_indices(count, 1)), "exhaustive")


def natural_order(names: Sequence[str]) -> Array:
    """Rows (N,) of the names in their natural order."""
    return np.array(sorted(range(len(names)), key=lambda row: natural_key(names[row])), dtype=np.int64)


def sequential_pairs(names: Sequence[str], look_ahead: int) -> PairTable:
    """Every image with the ``look_ahead`` images that follow it in the natural order of the names."""
    order = natural_order(names)
    steps = range(1, min(look_ahead, len(names) - 1) + 1)
    pairs = [np.column_stack([order[:-step], order[step:]]) for step in steps]
    return PairTable.of(np.concatenate(pairs) if pairs else np.zeros((0, 2)), "sequential")


def spatial_pairs(positions: Array, nearest: int) -> PairTable:
    """Every image with those that were taken nearest to it.

    Parameters
    ----------
    positions : (N,D) in metres, NaN where unknown; such images get no pairs.
    nearest : how many; an image may be chosen by more.
    """
    # loaded here, as the other choices do without
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    count = min(nearest, len(known) - 1)
    if count < 1:
        return PairTable.of(np.zeros((0, 2)), "spatial")
    # pictures taken at one place are all at distance 0, and the image itself need not come first
    _, rows = cKDTree(positions[known]).query(positions[known], k=count + 1)
    partners = np.where(rows == np.arange(len(known))[:, None], -1, rows)
    image, slot = np.nonzero(partners >= 0)
    return PairTable.of(np.column_stack([known[image], known[partners[image, slot]]]), "spatial")


def similar_pairs(
    blocks: Sequence[Array],
    read_block: Callable[[int], Array],
    top_k: int,
    min_score: float,
    held_bytes: int = HELD_BYTES,
    threads: int = 1,
    order: Array | None = None,
    look_ahead: int = 0,
) -> PairTable:
    """Every image with ``top_k`` images that resemble it, as :func:`choose_similar` chooses them.

    The similarity matrix is computed block by block. Some blocks of descriptors and the similarities of
    their images to all others are held while all blocks pass by once, so that few are read again; beside
    them one block is in memory.

    Parameters
    ----------
    blocks : image rows (n_a,) of each block, which together are 0 .. N-1.
    read_block : gives the descriptors (n_a,D) float32 of a block, as ``round_units`` has them.
    top_k : most partners that an image chooses; it may be chosen by more.
    min_score : least similarity, as :func:`similarities_of` has it; -1 keeps all that are finite.
    held_bytes : blocks are held until they take so much memory; at least one is.
    threads : how many blocks of the matrix are computed at a time; changes nothing in the result.
    order, look_ahead : as in :func:`choose_similar`.
    """
    found, scores = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.float32)]
    count = sum(map(len, blocks))
    choose = partial(choose_similar, top_k=top_k, order=order, look_ahead=look_ahead)
    first = 0
    while first < len(blocks):
        held = {first: read_block(first)}
        while (
            first + len(held) < len(blocks)
            and sum(own.nbytes + 4 * count * len(own) for own in held.values()) < held_bytes
        ):
            held[first + len(held)] = read_block(first + len(held))
        first += len(held)
        tables = {row: np.empty((len(own), count), np.float32) for row, own in held.items()}
        with ThreadPoolExecutor(threads) as pool:
            for column, columns in enumerate(blocks):
                other = held[column] if column in held else read_block(column)
                tasks = [pool.submit(_fill, tables[row], columns, held[row], other) for row in held]
                for task in tasks:
                    task.result()
            for row, table in tables.items():
                table[np.arange(len(table)), blocks[row]] = -np.inf
                # rounding lengthens descriptors: two that are opposite may give less than -1
                if min_score > -1:
                    table[table < min_score] = -np.inf
                for image, line, partners in zip(
                    blocks[row].tolist(), table, pool.map(choose, table), strict=True
                ):
                    found.append(np.column_stack([np.full(len(partners), image), partners]))
                    scores.append(line[partners])
    return PairTable.of(np.concatenate(found), "retrieved", np.concatenate(scores))


def choose_similar(
    similarities: Array, top_k: int, order: Array | None = None, look_ahead: int = 0
) -> Array:
    """The images (k,) most similar to one, at most ``top_k``; ties go to the smaller row.

    In a slow video they are near copies of the same moment. So with an order half of them are chosen first
    among those that are more similar than their neighbours in it: one of each moment, and of each other
    time at the same place.

    Parameters
    ----------
    similarities : (N,) of the image to all, -inf where one is never chosen.
    order : (N,) images in the order of their names, or None where that tells nothing.
    look_ahead : how many images before and behind an image in this order are its neighbours.
    """
    ranked = np.argsort(-similarities, kind="stable")
    if order is not None:
        # loaded here, as the other choices do without
        from scipy.ndimage import maximum_filter1d

        ordered = similarities[order]
        peaks = np.zeros(len(order), bool)
        peaks[order] = (ordered == maximum_filter1d(ordered, 2 * look_ahead + 1)) & (ordered > -np.inf)
        rest = ranked[(top_k + 1) // 2 :]
        ranked = np.concatenate([ranked[: (top_k + 1) // 2], rest[peaks[rest]], rest[~peaks[rest]]])
    chosen = ranked[:top_k]
    return chosen[similarities[chosen] > -np.inf]


def similarities_of(own: Array, other: Array) -> Array:
    """Dot products (n,m) float32 of descriptors (n,D) and (m,D); -inf for images without features.

    The descriptors of these are zeros. Images that have features may well have a negative similarity: most
    pairs of a small scene do, as the vocabulary is learned on the scene itself.
    """
    similarities: Array = own @ other.T
    similarities[~own.any(axis=1)] = -np.inf
    similarities[:, ~other.any(axis=1)] = -np.inf
    return similarities


def _fill(table: Array, columns: Array, own: Array, other: Array) -> None:
    table[:, columns] = similarities_of(own, other)
