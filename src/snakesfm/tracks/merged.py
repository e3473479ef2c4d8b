"""Track lengths before and after merging the keypoints of a detector-free matcher."""

from collections.abc import Callable

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of
from snakesfm.matching.merging import MergedKeypoints


def compare_track_lengths(
    keypoints: list[Array],
    pairs: Array,
    offsets: Array,
    matches: Array,
    found: Callable[[int, int], Array],
) -> tuple[Array, Array]:
    """Lengths of the tracks of the same matches, joined as they were found and in merged keypoints.

    Parameters
    ----------
    keypoints : per image (K_i,2) float32, merged, pixels.
    pairs : (P,2) int, images i < j.
    offsets : (P+1,) int64, rows ``offsets[k]:offsets[k+1]`` of ``matches`` belong to pair k.
    matches : (M,2) int, inliers: keypoint rows in image i and in image j.
    found : the coordinates (N,4) float32 that were found in a pair (i, j).

    Returns
    -------
    unmerged, merged : (U,) and (V,) int64, entry k is the number of connected components seen in k images.
    """
    trees = {image: MergedKeypoints(keypoints[image]) for image in np.unique(pairs).tolist()}
    raw, merged = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3))]
    for row, (i, j) in enumerate(pairs.tolist()):
        inliers = matches[offsets[row] : offsets[row + 1]].astype(np.int64)
        rows = np.stack([inliers, np.zeros_like(inliers)], axis=2)
        merged.append(_ends(i, j, rows[:, 0], rows[:, 1]))
        places = found(i, j)
        first = trees[i].nearest(places[:, :2], np.inf)
        second = trees[j].nearest(places[:, 2:], np.inf)
        among = np.isin(first * len(keypoints[j]) + second, inliers @ [len(keypoints[j]), 1])
        raw.append(_ends(i, j, places[among, :2], places[among, 2:]))
    return _lengths(np.concatenate(raw)), _lengths(np.concatenate(merged))


def describe_lengths(histogram: Array) -> str:
    """How many tracks there are, how long they are on average, and how many see two images only."""
    count = int(histogram.sum())
    if count == 0:
        return "no tracks"
    mean = float(histogram @ np.arange(len(histogram))) / count
    return f"{count:,} tracks of {mean:.2f} images on average, {100 * histogram[2] / count:.0f} % in two"


def _ends(i: int, j: int, first: Array, second: Array) -> Array:
    """Both ends (M,2,3) of matches: the image and two numbers that tell its places apart."""
    sides = ((i, first), (j, second))
    ends = [np.insert(part.astype(np.float64), 0, image, axis=1) for image, part in sides]
    return np.stack(ends, axis=1)


def _lengths(ends: Array) -> Array:
    if len(ends) == 0:
        return np.zeros(0, np.int64)
    distinct, flat = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
    labels = components_of(len(distinct), flat.reshape(-1, 2))
    seen = np.unique(np.column_stack([labels, distinct[:, 0].astype(np.int64)]), axis=0)[:, 0]
    return np.bincount(np.bincount(seen), minlength=3).astype(np.int64)
