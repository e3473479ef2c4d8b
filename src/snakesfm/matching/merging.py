"""Merging of the coordinates from a detector-free matcher into keypoints.

Such a matcher finds a place anew in every pair, up to some pixels from where it found it in another pair.
If every coordinate were a keypoint, nearly every track would end after two images. Coordinates of one image
are therefore merged over all its pairs, and the pairs are then expressed in the merged keypoints; hloc
(Sarlin et al. 2019) does the like on a grid.
"""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import one_to_one


def merge_coordinates(coordinates: Array, scores: Array, radius_px: float) -> tuple[Array, Array]:
    """Non-maximum suppression by confidence: the surest of all places first, then those far enough from it.

    Parameters
    ----------
    coordinates : (N,2) float32, pixels, in any order, even equal ones.
    scores : (N,) float32.
    radius_px : no two keypoints lie within this distance, and every place within it of a keypoint.

    Returns
    -------
    keypoints : (K,2) float32, surest first, ties by x and y; each is one of the coordinates.
    scores : (K,) float32.
    The order of the coordinates changes nothing.
    """
    from scipy.spatial import cKDTree

    if len(coordinates) == 0:
        return np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    order = np.lexsort((coordinates[:, 1], coordinates[:, 0], -scores))
    places, first = np.unique(coordinates[order], axis=0, return_index=True)
    rank = np.argsort(first)
    places, scores = places[rank], scores[order][first[rank]]
    tree = cKDTree(places)
    free = np.ones(len(places), bool)
    kept = []
    for row in range(len(places)):
        if free[row]:
            kept.append(row)
            free[tree.query_ball_point(places[row], radius_px)] = False
    return places[kept].astype(np.float32), scores[kept].astype(np.float32)


class MergedKeypoints:
    """The merged keypoints of one image, to look coordinates up.

    Parameters
    ----------
    keypoints : (K,2) float32 pixels, as :func:`merge_coordinates` returns them.
    """

    def __init__(self, keypoints: Array) -> None:
        from scipy.spatial import cKDTree

        self._tree = cKDTree(keypoints) if len(keypoints) else None

    def nearest(self, coordinates: Array, radius_px: float) -> Array:
        """Rows (N,) int64 of the keypoints nearest to coordinates (N,2), -1 beyond the radius."""
        if self._tree is None or len(coordinates) == 0:
            return np.full(len(coordinates), -1)
        # one representable number more, as the bound itself is excluded
        bound = np.nextafter(radius_px, np.inf)
        distances, rows = self._tree.query(coordinates, distance_upper_bound=bound)
        return np.where(np.isfinite(distances), rows, -1).astype(np.int64)


def index_coordinates(
    coordinates: Array, scores: Array, first: MergedKeypoints, second: MergedKeypoints, radius_px: float
) -> tuple[Array, Array]:
    """Express the places of a pair in the merged keypoints of its images.

    Of several places that fall to the same keypoint of either image the surest is kept.

    Parameters
    ----------
    coordinates, scores : (M,4) and (M,) float32, as a detector-free matcher returns them.
    first, second : the keypoints of the two images.
    radius_px : as the keypoints were merged with.

    Returns
    -------
    matches : (K,2) int32, keypoint rows in the two images, ascending, each row at most once.
    scores : (K,) float32.
    """
    rows = np.column_stack(
        [first.nearest(coordinates[:, :2], radius_px), second.nearest(coordinates[:, 2:], radius_px)]
    )
    known = (rows >= 0).all(axis=1)
    rows, scores = rows[known], scores[known]
    order = np.lexsort((rows[:, 1], rows[:, 0], -scores))
    kept = order[one_to_one(rows[order])]
    kept = kept[np.argsort(rows[kept, 0])]
    return rows[kept].astype(np.int32), scores[kept].astype(np.float32)
