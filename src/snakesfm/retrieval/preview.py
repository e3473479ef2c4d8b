"""A cheap preview of image pairs before matching: the likeness of their largest keypoints.

Pre-emptive matching (Wu 2013, "Towards linear-time incremental structure from motion", section 3.1): of two
images that see the same, keypoints of large scale match too. Wu counts the matches of the ratio test; among
so few descriptors the second nearest is far off and strangers pass it as well, so here every pair of mutual
nearest neighbours counts by how much nearer it is than the second nearest.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from snakesfm.arrays import Array
from snakesfm.matching.nearest import augmented, pop_two_largest, ratios_of

FEWEST_KEYPOINTS = 50
"""Keypoints by which images with few of them are previewed."""
# images that see parts of one view are fewer partners apart
LOOP_STEPS = 4


def largest_keypoints(scales: Array, count: int) -> Array:
    """Rows (n,) of the keypoints (N,) of largest scale, the earlier of equal ones first.

    ``count`` of them, or half of those of an image that has fewer than twice as many, but no fewer than
    ``FEWEST_KEYPOINTS`` as far as there are.
    """
    few = max(len(scales) // 2, FEWEST_KEYPOINTS)
    return np.argsort(-scales, kind="stable")[: min(count, few)]


def likeness(first: Array, second: Array) -> float:
    """How much two sets of descriptors (N,D) and (M,D) resemble each other, N and M at least two.

    The sum of (1 - r)^2 over all mutual nearest neighbours, where r is the distance over that to the second
    nearest. 400 keypoints of unrelated images give about 1.3, those of images that overlap 2 to 100.
    """
    block = augmented(first, norm_first=True) @ augmented(second, norm_first=False).T
    column_first = block.max(axis=0)
    nearest, best, runner_up = pop_two_largest(block)
    mutual = best == column_first[nearest]
    # rounding of float descriptors may lift the product of equal ones above zero
    ratios = ratios_of(np.minimum(best[mutual], 0), np.minimum(runner_up[mutual], 0))
    return float(np.square(1 - ratios, dtype=np.float64).sum())


def look_at_pairs(pairs: Array, previews: Sequence[Array], count: int, threads: int = 1) -> Array:
    """The likeness of pairs of images.

    Parameters
    ----------
    pairs : (P,2) rows of images.
    previews : descriptors (n,D) of each image's largest keypoints.
    count : keypoints compared per image, if it has enough; fewer keypoints resemble others less, so their
        likeness is scaled up to this number.
    threads : how many pairs are previewed at a time; changes nothing in the result.

    Returns
    -------
    (P,) float32, 0 where either image has next to no keypoints.
    """

    def look(part: Array) -> list[float]:
        values = []
        for i, j in part.tolist():
            fewer = min(len(previews[i]), len(previews[j]))
            # of next to no keypoints, likeness is noise that must not stand out
            scale = count / min(count, max(fewer, FEWEST_KEYPOINTS))
            values.append(likeness(previews[i], previews[j]) * scale if fewer > 1 else 0.0)
        return values

    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(look, np.array_split(pairs, threads)))
    return np.concatenate([np.asarray(values, np.float32) for values in found])


def alike_pairs(
    pairs: Array, likenesses: Array, unsure: Array, min_likeness: float, least_partners: int
) -> Array:
    """Which pairs (P,) bool are alike enough, or among the most alike ones of an image.

    Where photographs overlap little, the largest keypoints of many neighbours resemble each other as
    little as strangers' do.

    Parameters
    ----------
    pairs : (P,2) rows of images, distinct.
    likenesses : (P,) as :func:`look_at_pairs` has them.
    unsure : (P,) bool, pairs previewed with too few keypoints to recognise unrelated images; they stay.
    min_likeness : what is enough.
    least_partners : of each image so many stay however little they resemble it.
    """
    stays = (likenesses >= min_likeness) | unsure
    rows, _, ranks, _ = _ranked(pairs, likenesses, np.arange(len(pairs)))
    stays[rows[ranks < least_partners]] = True
    return stays


def choose_partners(pairs: Array, likenesses: Array, enough_partners: int, enough_likeness: float) -> Array:
    """Which pairs stay where each image needs only so many partners; a pair stays if either image keeps it.

    Half of an image's partners are those most alike, the other half every second one of the next: these see
    less of the same, but from farther apart, and poses need both. An image whose partners are alike in
    little keeps more, as few matches have to be made up for by many pairs. Last come pairs that close a
    loop, whose images are more than ``LOOP_STEPS`` partners apart, a tenth of what is enough: in a long
    sequence that comes back to where it was, neighbours in time are more alike. They are taken in rounds
    until no such pair is left, as all near copies of a stop may prefer the same one of its neighbours.

    Parameters
    ----------
    pairs : (P,2) rows of images, distinct.
    likenesses : (P,) as :func:`look_at_pairs` has them.
    enough_partners : how many partners an image keeps.
    enough_likeness : it keeps more until the likeness of those kept sums to this.

    Returns
    -------
    (P,) bool.
    """
    stays = np.zeros(len(pairs), dtype=bool)
    rows, images, ranks, values = _ranked(pairs, likenesses, np.arange(len(pairs)))
    order = np.lexsort((_turns(ranks, enough_partners), images))
    places = _ranks_within(images, order)
    sums = np.cumsum(values[order]) - values[order]
    # what earlier images sum to is taken off, which is the sum in front of each image's first
    sums -= sums[np.arange(len(order)) - places[order]]
    kept = (places[order] < enough_partners) | (sums < enough_likeness)
    stays[rows[order[kept]]] = True
    closing = np.flatnonzero(~stays)
    while len(closing := closing[~_joined(pairs[closing], pairs[stays])]):
        rows, _, ranks, _ = _ranked(pairs, likenesses, closing)
        stays[rows[ranks < max(1, enough_partners // 10)]] = True
        closing = closing[~stays[closing]]
    return stays


def _ranked(pairs: Array, likenesses: Array, rows: Array) -> tuple[Array, Array, Array, Array]:
    """Some pairs, once from either image's side: row, image, the partner's rank for it, likeness."""
    images, partners = pairs[rows].T.ravel(), pairs[rows][:, ::-1].T.ravel()
    values = np.tile(likenesses[rows].astype(np.float64), 2)
    ranks = _ranks_within(images, np.lexsort((partners, -values, images)))
    return np.tile(rows, 2), images, ranks, values


def _joined(pairs: Array, kept: Array) -> Array:
    """Whether at most ``LOOP_STEPS`` kept pairs (K,2) lead from one image of a pair (P,2) to the other."""
    if len(pairs) == 0:
        return np.zeros(0, bool)
    count = 1 + int(max(pairs.max(), kept.max(initial=0)))
    both = np.concatenate([kept, kept[:, ::-1], np.column_stack([np.arange(count)] * 2)])
    both = both[np.argsort(both[:, 0], kind="stable")]
    partners = np.split(both[:, 1], np.searchsorted(both[:, 0], np.arange(1, count)))
    # one bit per image, so that sets of thousands are joined at once
    own = np.zeros((count, -(-count // 8)), np.uint8)
    np.bitwise_or.at(own, (both[:, 0], both[:, 1] // 8), (128 >> both[:, 1] % 8).astype(np.uint8))
    reached = own
    for _ in range(LOOP_STEPS - 1):
        reached = np.stack([np.bitwise_or.reduce(reached[rows], axis=0) for rows in partners])
    first, second = pairs.T
    joined: Array = reached[first, second // 8] & (128 >> second % 8).astype(np.uint8) > 0
    return joined


def _turns(ranks: Array, enough: int) -> Array:
    """When partners of each rank, 0 is the most alike, are taken: first half, every second, the rest."""
    near = (enough + 1) // 2
    far = ranks - near
    alternate = (far >= 0) & (far < 2 * (enough // 2)) & (far % 2 == 0)
    last = ranks.max(initial=0) + 1
    return np.where(ranks < near, ranks, np.where(alternate, ranks, ranks + last))


def _ranks_within(groups: Array, order: Array) -> Array:
    """The rank of every element among those of its group, where ``order`` sorts by group first."""
    ordered = groups[order]
    ranks = np.empty(len(groups), np.int64)
    ranks[order] = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    return ranks
