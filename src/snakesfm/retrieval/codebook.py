"""A codebook of local descriptors, learned by k-means on the scene itself."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import offsets_of

ROWS_AT_ONCE = 4096


def sample_rows(count: int, samples: int, seed: int) -> Array:
    """At most ``samples`` of the rows 0 .. count-1, (S,) int64 ascending, drawn without replacement."""
    if count <= samples:
        return np.arange(count)
    drawn = np.random.default_rng(seed).choice(count, size=samples, replace=False, shuffle=False)
    return np.sort(drawn)


def largest_rows(scales: Array, share: float) -> Array:
    """Rows (M,) ascending of the ``share`` of keypoints with the largest scales (N,); at least one if any.

    Coarse structure is seen again from farther away than fine structure and is less repetitive.
    """
    count = int(np.ceil(share * len(scales)))
    return np.sort(np.argsort(-scales, kind="stable")[:count])


def nearest_words(descriptors: Array, centers: Array) -> Array:
    """The nearest centre of every descriptor.

    Parameters
    ----------
    descriptors : (N,D), any real dtype.
    centers : (W,D) float32.

    Returns
    -------
    (N,) int64 rows of ``centers``.
    """
    half_norms = np.einsum("wd,wd->w", centers, centers) / 2
    words = np.empty(len(descriptors), np.int64)
    for start in range(0, len(descriptors), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        block = descriptors[rows].astype(np.float32) @ centers.T
        block -= half_norms
        words[rows] = block.argmax(axis=1)
    return words


def learn_codebook(descriptors: Array, words: int, iterations: int, seed: int) -> Array:
    """Cluster descriptors by k-means (Lloyd 1982), started from distinct descriptors drawn at random.

    Parameters
    ----------
    descriptors : (N,D), any real dtype.
    words : most clusters; fewer come back where there are fewer distinct descriptors.
    iterations : rounds; stops early when no descriptor changes its cluster.
    seed : for the draw of the first centres.

    Returns
    -------
    (W,D) float32 centres, W <= words.
    """
    distinct = np.unique(np.asarray(descriptors), axis=0) if len(descriptors) <= words else None
    if distinct is not None:
        return distinct.astype(np.float32)
    centers = descriptors[sample_rows(len(descriptors), words, seed)].astype(np.float32)
    assigned = np.full(len(descriptors), -1)
    for _ in range(iterations):
        closest = nearest_words(descriptors, centers)
        if np.array_equal(closest, assigned):
            break
        assigned = closest
        sums, counts = sum_by_word(descriptors, assigned, len(centers))
        # a cluster that lost its last member keeps its centre
        filled = counts > 0
        centers[filled] = (sums[filled] / counts[filled, None]).astype(np.float32)
    return centers


def sum_by_word(descriptors: Array, words: Array, word_count: int) -> tuple[Array, Array]:
    """Sums (W,D) float64 and counts (W,) int64 of the descriptors (N,D) of each word."""
    counts = np.bincount(words, minlength=word_count)
    order = np.argsort(words, kind="stable")
    starts = offsets_of(counts)
    sums = np.zeros((word_count, descriptors.shape[1]))
    for word in np.flatnonzero(counts):
        sums[word] = descriptors[order[starts[word] : starts[word + 1]]].sum(axis=0, dtype=np.float64)
    return sums, counts
