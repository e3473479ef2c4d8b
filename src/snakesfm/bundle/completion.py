"""Completion of the model: tracks are completed and merged, points triangulated from unused matches."""

from collections.abc import Mapping, Sequence

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.reading import read_tracks
from snakesfm.geometry.colmap_binding import pycolmap

# pycolmap takes no angle of zero
SMALLEST_ANGLE_DEG = 1e-9


def correspondence_graph(
    keypoint_counts: Mapping[int, int], pairs: Array, offsets: Array, matches: Array
) -> pycolmap.CorrespondenceGraph:
    """The inlier matches for pycolmap's triangulator.

    Parameters
    ----------
    keypoint_counts : by image, of those that take part.
    pairs : (P,2) int, images i < j.
    offsets : (P+1,) int64, rows ``offsets[k]:offsets[k+1]`` of ``matches`` belong to pair k.
    matches : (M,2) int, keypoint rows in image i and in image j.
    """
    graph = pycolmap.CorrespondenceGraph()
    for row, count in keypoint_counts.items():
        graph.add_image(row + 1, count)
    for row, (i, j) in enumerate(pairs.tolist()):
        found = matches[offsets[row] : offsets[row + 1]]
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = found.astype(np.uint32)
        graph.add_two_view_geometry(i + 1, j + 1, geometry)
    graph.finalize()
    return graph


def drop_repeated_observations(reconstruction: pycolmap.Reconstruction) -> None:
    """Keep the first of several observations of a point by one image.

    pycolmap's completion and merging do not prevent them, notably where SIFT gave one place twice.
    """
    tracks = read_tracks(reconstruction)
    points, images, rows = tracks.ids[tracks.point_rows], tracks.images, tracks.rows
    order = np.lexsort((rows, images, points))
    again = (np.diff(points[order]) == 0) & (np.diff(images[order]) == 0)
    for row in order[1:][again].tolist():
        if reconstruction.exists_point3D(int(points[row])):
            reconstruction.delete_observation(int(images[row]) + 1, int(rows[row]))


def complete_tracks(
    reconstruction: pycolmap.Reconstruction,
    graph: pycolmap.CorrespondenceGraph,
    max_error_px: float,
    min_angle_deg: float,
    seed: int,
    images: Sequence[int] | None = None,
) -> None:
    """Complete and merge all tracks by pycolmap's triangulator, and triangulate left-out matches.

    Parameters
    ----------
    reconstruction : changed in place.
    graph : inlier matches.
    max_error_px : largest reprojection error of an added observation.
    min_angle_deg : smallest triangulation angle of a new point.
    seed : of the robust estimation.
    images : rows of the images whose left-out matches are triangulated; all registered ones if None.
    """
    options = pycolmap.IncrementalTriangulatorOptions()
    options.complete_max_reproj_error = max_error_px
    options.merge_max_reproj_error = max_error_px
    options.min_angle = max(min_angle_deg, SMALLEST_ANGLE_DEG)
    options.ignore_two_view_tracks = True
    options.random_seed = seed
    triangulator = pycolmap.IncrementalTriangulator(graph, reconstruction)
    registered = sorted(reconstruction.reg_image_ids())
    for image_id in registered if images is None else [row + 1 for row in images]:
        triangulator.triangulate_image(options, image_id)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    drop_repeated_observations(reconstruction)
