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
    images = pairs.astype(np.int32)
    merged = _lengths(np.repeat(images, np.diff(offsets), axis=0), matches[offsets[0] : offsets[-1]])
    counts, places = _places_as_found(keypoints, pairs, offsets, matches, found)
    return _lengths(np.repeat(images, counts, axis=0), places), merged


def describe_lengths(histogram: Array) -> str:
    """How many tracks there are, how long they are on average, and how many see two images only."""
    count = int(histogram.sum())
    if count == 0:
        return "no tracks"
    mean = float(histogram @ np.arange(len(histogram))) / count
    return f"{count:,} tracks of {mean:.2f} images on average, {100 * histogram[2] / count:.0f} % in two"


def _places_as_found(
    keypoints: list[Array],
    pairs: Array,
    offsets: Array,
    matches: Array,
    found: Callable[[int, int], Array],
) -> tuple[Array, Array]:
    """How many places of each pair (P,) are of its matches, and these in image i and in image j (K,2).

    A place is one int64, which holds its two coordinates.
    """
    trees = {image: MergedKeypoints(keypoints[image]) for image in np.unique(pairs).tolist()}
    chosen = [np.zeros((0, 2), np.int64)]
    for row, (i, j) in enumerate(pairs.tolist()):
        inliers = matches[offsets[row] : offsets[row + 1]].astype(np.int64)
        places = found(i, j)
        first = trees[i].nearest(places[:, :2], np.inf)
        second = trees[j].nearest(places[:, 2:], np.inf)
        among = np.isin(first * len(keypoints[j]) + second, inliers @ [len(keypoints[j]), 1])
        # -0 is where 0 is, but has other bits
        coordinates = np.ascontiguousarray(places[among], np.float32) + np.float32(0)
        chosen.append(coordinates.view(np.int64))
    return np.array([len(part) for part in chosen[1:]], np.int64), np.concatenate(chosen)


def _lengths(images: Array, places: Array) -> Array:
    """Histogram of the lengths of the tracks of matches, whose two ends (M,2) int are places in images."""
    if len(images) == 0:
        return np.zeros(0, np.int64)
    image_of, place_of = images.ravel(), places.ravel()
    order = np.lexsort((place_of, image_of))
    image_of, place_of = image_of[order], place_of[order]
    first = np.ones(len(order), bool)
    first[1:] = (image_of[1:] != image_of[:-1]) | (place_of[1:] != place_of[:-1])
    nodes = np.empty(len(order), np.int64)
    nodes[order] = np.cumsum(first) - 1
    image_of = image_of[first].astype(np.int64)
    labels = components_of(len(image_of), nodes.reshape(-1, 2))
    count = int(image_of.max()) + 1
    seen = np.unique(labels * count + image_of) // count
    return np.bincount(np.bincount(seen), minlength=3).astype(np.int64)
