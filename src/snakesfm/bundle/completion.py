"""Completion of the model: tracks are completed and merged, points triangulated from unused matches."""

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.reading import read_keypoints, read_tracks
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import offsets_of, starts_of

# pycolmap takes no angle of zero
SMALLEST_ANGLE_DEG = 1e-9
# of all matches, in ordinary sets .95 and more, of 30 near copies of each photograph .5
MOST_WITH_PARALLAX = 0.9
# that are looked at first: where most of their matches have parallax, no others need be
SOME_PAIRS = 100


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
    for row in order[~starts_of(points[order], images[order])].tolist():
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
    # to look at all matches is worth it for many images
    telling = graph if images else matches_with_parallax(reconstruction, graph, options.min_angle)
    creating = pycolmap.IncrementalTriangulator(telling, reconstruction)
    registered = sorted(reconstruction.reg_image_ids())
    for image_id in registered if images is None else [row + 1 for row in images]:
        creating.triangulate_image(options, image_id)
    triangulator = pycolmap.IncrementalTriangulator(graph, reconstruction)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    drop_repeated_observations(reconstruction)


def matches_with_parallax(
    reconstruction: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph, min_angle_deg: float
) -> pycolmap.CorrespondenceGraph:
    """The matches that may give new points; all of them where these are most.

    The triangulator tries all pairs of a keypoint's matches, most of them in vain in dense video, where
    near copies match. Left out are matches of two keypoints of which neither has a match whose ray is off
    its own by half the angle: the rays of no two of its matches are by the whole.
    """
    pixels = read_keypoints(reconstruction)
    chord = 2.0 * np.sin(np.radians(min_angle_deg) / 4.0)

    @functools.cache
    def rays_of(image_id: int) -> Array:
        image = reconstruction.image(image_id)
        camera = reconstruction.camera(image.camera_id)
        seen = np.column_stack([camera.cam_from_img(pixels[image_id]), np.ones(len(pixels[image_id]))])
        seen = seen @ image.cam_from_world().rotation.matrix()
        return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))

    def matches_of(i: int, j: int) -> tuple[Array, Array]:
        matches = graph.extract_matches_between_images(i, j)
        apart = np.linalg.norm(rays_of(i)[matches[:, 0]] - rays_of(j)[matches[:, 1]], axis=1)
        # a ray that is not finite tells nothing
        return matches, ~(apart < chord)

    pairs = sorted(map(pycolmap.pair_id_to_image_pair, graph.image_pairs()))
    pairs = [(i, j) for i, j in pairs if i in pixels and j in pixels]
    some = [matches_of(i, j)[1] for i, j in pairs[:: max(1, len(pairs) // SOME_PAIRS)]]
    if not some or np.mean(np.concatenate(some)) >= MOST_WITH_PARALLAX:
        return graph
    found = {pair: matches_of(*pair) for pair in pairs}
    told = {image_id: np.zeros(len(of_image), dtype=bool) for image_id, of_image in pixels.items()}
    for (i, j), (matches, wide) in found.items():
        told[i][matches[wide, 0]] = told[j][matches[wide, 1]] = True
    kept = {(i, j): m[told[i][m[:, 0]] | told[j][m[:, 1]]] for (i, j), (m, _) in found.items()}
    lengths = [len(matches) for matches in kept.values()]
    if sum(lengths) >= MOST_WITH_PARALLAX * sum(len(matches) for matches, _ in found.values()):
        return graph
    counts = {image_id - 1: image.num_points2D() for image_id, image in reconstruction.images.items()}
    rows = np.array(list(kept), dtype=np.int64).reshape(-1, 2) - 1
    return correspondence_graph(counts, rows, offsets_of(lengths), np.concatenate([*kept.values()]))
