"""Mutual nearest neighbours with the ratio test, searched only among descriptors of similar words."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import offsets_of
from snakesfm.matching.nearest import accept, augmented, no_matches, pop_two_largest

# fewer descriptors per word and the loop over the words costs more than the products it saves
MIN_PER_WORD = 64
SAMPLES_PER_WORD = 64
LLOYD_ROUNDS = 4
# 2 MB of products stay in the processor's second and third cache
PRODUCTS_AT_ONCE = 1 << 19


@dataclass(frozen=True)
class ClusteredSearch:
    """The descriptors of one image, grouped by the words of its own small codebook.

    Descriptors of another image fall into the group of their nearest word and are compared only with the
    descriptors that probe this word (Jegou et al. 2011, "Product quantization", section IV: inverted file,
    multiple assignment). Which words are probed is decided for the image as a whole: those pairs of
    descriptor and word where the descriptor is nearest to the plane between the word's cell and its own. So
    doubtful descriptors probe many words and clear ones only their own.

    The codebook is learned from this image alone by a fixed rule: the matches of a pair depend on nothing
    but the pair. With uint8 descriptors centres are integers and every product is exact in float32,
    whatever the BLAS. Where all words are probed, as with a single one, the search is exact. Memory: about
    ``4 * (probes + 2) * N * D`` bytes for N descriptors, and two float32 copies of the other image's.

    Parameters
    ----------
    count : number N of descriptors.
    centers : (W,D) float32 codebook.
    vectors : (E,D+2) float32, descriptors as :func:`augmented` makes them, word after word.
    offsets : (W+1,) rows ``offsets[w]:offsets[w+1]`` of ``vectors`` probe word w.
    by_row : (E,) rows of ``vectors``, sorted by the descriptor they hold.
    owners : (E,) descriptor of each entry of ``by_row``.
    starts : (N,) first entry of each descriptor in ``by_row``.
    """

    count: int
    centers: Array
    vectors: Array
    offsets: Array
    by_row: Array
    owners: Array
    starts: Array

    @classmethod
    def build(cls, descriptors: Array, words: int, probes: float) -> "ClusteredSearch":
        """Prepare the descriptors of an image.

        Parameters
        ----------
        descriptors : (N,D), any real dtype.
        words : size of the codebook, 256 at most; images with few descriptors get a smaller one.
        probes : words that a descriptor probes, on average over the image.
        """
        centers = learn_small_codebook(descriptors, min(words, max(1, len(descriptors) // MIN_PER_WORD)))
        vectors = augmented(descriptors, norm_first=True)
        word, row = np.nonzero(_probed(vectors[:, :-2], centers, probes).T)
        by_row = np.argsort(row, kind="stable")
        owners = row[by_row]
        return cls(
            count=len(descriptors),
            centers=centers,
            vectors=vectors[row],
            offsets=offsets_of(np.bincount(word, minlength=len(centers))),
            by_row=by_row,
            owners=owners,
            starts=np.searchsorted(owners, np.arange(len(descriptors))),
        )

    def match(self, descriptors: Array, max_ratio: float) -> tuple[Array, Array]:
        """Match with the descriptors (M,D) of another image.

        Arguments and results as in :func:`snakesfm.matching.nearest.accept`; the second nearest and the way
        back are those among the descriptors that were compared.
        """
        if self.count < 2 or len(descriptors) < 2:
            return no_matches()
        vectors = augmented(descriptors, norm_first=False)
        word = _affinities(vectors[:, :-2], self.centers).argmax(axis=1).astype(np.uint8)
        order = np.argsort(word, kind="stable")
        nearest, first, second, column_first = self._compare(
            vectors[order], offsets_of(np.bincount(word, minlength=len(self.centers)))
        )
        # of every descriptor, the best over the words it probed
        values = first[self.by_row]
        best = np.maximum.reduceat(values, self.starts)
        at = np.flatnonzero(values == best[self.owners])[::-1]
        winner = np.empty(self.count, np.int64)
        # the last write counts: the first of equal ones, as in a search from front to back
        winner[self.owners[at]] = at
        chosen = self.by_row[winner]
        values[winner] = second[chosen]
        runner_up = np.maximum.reduceat(values, self.starts)
        matches, scores = accept(nearest[chosen], best, runner_up, column_first, max_ratio)
        matches[:, 1] = order[matches[:, 1]]
        return matches, scores

    def _compare(self, others: Array, offsets: Array) -> tuple[Array, Array, Array, Array]:
        """Nearest, first and second of every entry, and the first of every row of ``others``."""
        entries = len(self.vectors)
        nearest = np.zeros(entries, np.int64)
        first = np.full(entries, -np.inf, np.float32)
        second = np.full(entries, -np.inf, np.float32)
        column_first = np.full(len(others), -np.inf, np.float32)
        buffer = np.empty(max(PRODUCTS_AT_ONCE, len(others)), np.float32)
        mine, theirs = self.offsets.tolist(), offsets.tolist()
        for word in range(len(self.centers)):
            columns = slice(theirs[word], theirs[word + 1])
            width = columns.stop - columns.start
            if width == 0:
                continue
            step = max(1, PRODUCTS_AT_ONCE // width)
            for start in range(mine[word], mine[word + 1], step):
                rows = slice(start, min(start + step, mine[word + 1]))
                height = rows.stop - start
                block = buffer[: height * width].reshape(height, width)
                np.matmul(self.vectors[rows], others[columns].T, out=block)
                np.maximum(column_first[columns], block.max(axis=0), out=column_first[columns])
                best, first[rows], second[rows] = pop_two_largest(block)
                nearest[rows] = best + columns.start
        return nearest, first, second, column_first


def learn_small_codebook(descriptors: Array, words: int) -> Array:
    """Centres (W,D) float32 of a short k-means on evenly spaced rows, integers if the descriptors are.

    Parameters
    ----------
    descriptors : (N,D), any real dtype.
    words : number W of centres; a centre that attracts nothing stays where it was.
    """
    if len(descriptors) == 0:
        return np.zeros((words, descriptors.shape[1]), np.float32)
    count = min(len(descriptors), SAMPLES_PER_WORD * words)
    sample = descriptors[np.linspace(0, len(descriptors) - 1, count).astype(np.int64)].astype(np.float32)
    centers = sample[np.linspace(0, count - 1, words).astype(np.int64)]
    for _ in range(LLOYD_ROUNDS):
        word = _affinities(sample, centers).argmax(axis=1)
        sizes = np.bincount(word, minlength=words)
        used = sizes > 0
        sums = np.add.reduceat(sample[np.argsort(word, kind="stable")], offsets_of(sizes)[:-1][used])
        centers[used] = sums / sizes[used, None]
        if descriptors.dtype.kind in "ui":
            np.rint(centers, out=centers)
    return centers


def _probed(vectors: Array, centers: Array, probes: float) -> Array:
    """Which words each descriptor probes: (N,W) bool, the nearest always, ``probes`` on average."""
    if probes >= len(centers):
        return np.ones((len(vectors), len(centers)), bool)
    affinities = _affinities(vectors, centers)
    own = affinities.argmax(axis=1)
    squares = np.einsum("wd,wd->w", centers, centers)
    apart = np.sqrt(np.maximum(squares[:, None] + squares - 2 * (centers @ centers.T), 0))
    apart[apart == 0] = 1
    # distance to the plane halfway between the two centres
    margins = (affinities[np.arange(len(own)), own][:, None] - affinities) / apart[own]
    last = int(probes * len(own)) - 1
    probed: Array = margins <= np.partition(margins.ravel(), last)[last]
    return probed


def _affinities(vectors: Array, centers: Array) -> Array:
    """Minus half the squared distance of each vector to each centre, (N,W), up to a constant of the row."""
    products: Array = vectors @ centers.T
    products -= np.einsum("wd,wd->w", centers, centers) / np.float32(2)
    return products
