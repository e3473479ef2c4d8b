"""From matched keypoints to correspondences: duplicates, rays, and one match per position."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.camera import Camera
from snakesfm.grouping import one_to_one
from snakesfm.two_view.sampson import Correspondences


def first_rows_at_place(keypoints: Array) -> Array:
    """For each keypoint (N,2) the first row (N,) int64 with the same coordinates.

    A detector gives one keypoint per orientation; tracks need one keypoint per place.
    """
    points = np.ascontiguousarray(keypoints, dtype=np.float32) + np.float32(0.0)
    places = points.view(np.int64).ravel()
    _, first, inverse = np.unique(places, return_index=True, return_inverse=True)
    return first[inverse]


def unify_matches(places_i: Array, places_j: Array, matches: Array) -> Array:
    """Matches (M,2) between the first rows of each place, each once, in the order of their occurrence.

    Parameters
    ----------
    places_i, places_j : (N,) int64, :func:`first_rows_at_place` of each image's keypoints.
    """
    if len(matches) == 0:
        return np.zeros((0, 2), dtype=np.int32)
    places = np.column_stack([places_i[matches[:, 0]], places_j[matches[:, 1]]])
    _, first = np.unique(places[:, 0] * len(places_j) + places[:, 1], return_index=True)
    return places[np.sort(first)].astype(np.int32)


def correspond(
    keypoints_i: Array, keypoints_j: Array, matches: Array, camera_i: Camera, camera_j: Camera
) -> Correspondences:
    """Undistorted rays of the matched keypoints.

    Parameters
    ----------
    keypoints_i, keypoints_j : (N,2) all keypoints of each image, in the pixels of its camera.
    matches : (M,2) int, keypoint rows in image i and in image j.
    camera_i, camera_j : intrinsics of the two images.

    Returns
    -------
    M correspondences in the order of the matches; a ray is NaN where its pixel has none.
    """
    return Correspondences(
        _rays(camera_i, keypoints_i[matches[:, 0]]),
        _rays(camera_j, keypoints_j[matches[:, 1]]),
        camera_i.focal_px,
        camera_j.focal_px,
    )


def _rays(camera: Camera, keypoints: Array) -> Array:
    points = camera.normalize(keypoints)
    return np.column_stack([points, np.ones(len(points))])


def unique_matches(matches: Array, errors: Array, selected: Array) -> Array:
    """Rows of the selected (M,) bool matches (M,2), each keypoint at most once.

    Parameters
    ----------
    matches : (M,2) int, keypoint rows in image i and in image j.
    errors : (M,) in any unit; of two matches at one keypoint the one whose error is nearer to zero stays.
    selected : (M,) bool.

    Returns
    -------
    (K,) int64, ascending.
    """
    rows = np.nonzero(selected)[0]
    ordered = rows[np.argsort(np.abs(errors[rows]), kind="stable")]
    return np.sort(ordered[one_to_one(matches[ordered])])
