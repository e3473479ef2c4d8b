"""Adjustment of large models with a selection of their points; the others follow with fixed cameras."""

from collections.abc import Container

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.following import Views, follow_cameras
from snakesfm.bundle.interface import BundleAdjuster, SolverSettings
from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.bundle.reading import Tracks, read_tracks, read_tracks_and_pixels
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_writing import keypoints_of_observations
from snakesfm.grouping import offsets_of

# each image must see enough of them to tell its own numbers
POINTS_PER_IMAGE = 15
# images that see a point, twice what is usual
LONG_TRACK = 10


def select_points(point_rows: Array, images: Array, count: int, per_image: int, seed: int) -> Array:
    """Points that are among the first ``per_image`` of any image, those seen by most images first.

    So every image keeps as many observations as it has, up to ``per_image`` and somewhat more, and the
    points are those that tie most images together (track selection as in GLOMAP, Pan et al., ECCV 2024,
    and 1DSfM's cover). Ties are drawn: rows of keypoints may follow their places in the image.

    Parameters
    ----------
    point_rows, images : (L,) int, point and image of each observation.
    count : number of points.
    per_image : observations that an image is to keep.
    seed : of the draw.

    Returns
    -------
    (count,) bool.
    """
    lengths = np.bincount(point_rows, minlength=count)
    order = np.lexsort((np.random.default_rng(seed).permutation(count), -lengths))
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    by_image = np.argsort(images.astype(np.int64) * count + rank[point_rows])
    sizes = np.bincount(images)
    place = np.arange(len(images)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    chosen = np.zeros(count, dtype=bool)
    chosen[point_rows[by_image[place < per_image]]] = True
    return chosen


def adjust_selection(
    reconstruction: pycolmap.Reconstruction,
    adjust: BundleAdjuster,
    solving: SolverSettings,
    per_image: int,
    seed: int,
) -> tuple[float, float]:
    """One pass of a solver on the points of :func:`select_points`, then all other points by themselves.

    Parameters
    ----------
    reconstruction : changed in place: intrinsics, poses and points.
    adjust, solving : the solver and what it is told.
    per_image, seed : how points are chosen.

    Returns
    -------
    The robust cost of the chosen points before and after, px^2.
    """
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    ids, points = tracks.ids, tracks.points
    if not len(points):
        return 0.0, 0.0
    chosen = select_points(tracks.point_rows, tracks.images, len(points), per_image, seed)
    small = with_points(reconstruction, tracks, pixels, chosen)
    others = ~chosen[tracks.point_rows]
    followers, owners = np.unique(tracks.point_rows[others], return_inverse=True)
    images, pixels = tracks.images[others].astype(np.int32), pixels[others]
    # the solver needs the memory
    del tracks, others
    costs = adjust(small, solving)
    points[chosen] = read_tracks(small).points
    for camera_id, camera in small.cameras.items():
        reconstruction.camera(camera_id).params = camera.params
    for image_id in small.reg_image_ids():
        image = reconstruction.image(image_id)
        image.frame.set_cam_from_world(image.camera_id, small.image(image_id).cam_from_world())
    views = Views.of(reconstruction, images, pixels)
    points[followers] = follow_cameras(points[followers], owners, views, solving.loss_scale_px)
    for point_id, xyz in zip(ids.tolist(), points, strict=True):
        reconstruction.point3D(point_id).xyz = xyz
    return costs


def with_points(
    reconstruction: pycolmap.Reconstruction,
    tracks: Tracks,
    pixels: Array,
    chosen: Array,
    split: Container[int] = (),
) -> pycolmap.Reconstruction:
    """The cameras and poses with some of the points, and only the keypoints that observe them.

    Parameters
    ----------
    reconstruction : gives the cameras and poses.
    tracks, pixels : its observations, see :func:`read_tracks_and_pixels`.
    chosen : (T,) bool, the points.
    split : ids of cameras of which each image gets a copy of its own.
    """
    mine = chosen[tracks.point_rows]
    images = tracks.images[mine]
    count = max(reconstruction.images)
    camera_ids = np.zeros(count, dtype=np.int64)
    rotations, translations = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    camera_count = max(reconstruction.cameras)
    cameras = [Camera.of_pycolmap(reconstruction.camera(row + 1)) for row in range(camera_count)]
    for image_id, image in sorted(reconstruction.images.items()):
        camera_ids[image_id - 1] = image.camera_id - 1
        if image.camera_id in split:
            camera_ids[image_id - 1] = len(cameras)
            cameras.append(cameras[image.camera_id - 1])
        if image.has_pose:
            pose = image.cam_from_world()
            rotations[image_id - 1], translations[image_id - 1] = pose.rotation.matrix(), pose.translation
    keypoints, keypoint_ids = keypoints_of_observations(images, pixels[mine], count)
    lengths = np.bincount(tracks.point_rows, minlength=len(chosen))[chosen]
    model = BundleModel(
        tuple(cameras),
        camera_ids,
        rotations,
        translations,
        tracks.points[chosen],
        offsets_of(lengths),
        images,
        keypoint_ids,
    )
    return to_reconstruction(model, keypoints, [str(row) for row in range(count)])


def with_some_points(
    reconstruction: pycolmap.Reconstruction, most: int, split: Container[int] = ()
) -> pycolmap.Reconstruction:
    """The same with so many points at most, or 15 per image if more, spread over all: for trials.

    Where these are seen by so many images that they cost more than as many usual ones, fewer that leave
    each image about as many observations as any other.
    """
    most = max(most, POINTS_PER_IMAGE * reconstruction.num_reg_images())
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    chosen = np.zeros(len(tracks.points), dtype=bool)
    chosen[:: -(-len(chosen) // most) or 1] = True
    per_image = LONG_TRACK * most // max(reconstruction.num_reg_images(), 1)
    while np.count_nonzero(chosen[tracks.point_rows]) > LONG_TRACK * most and per_image:
        chosen = select_points(tracks.point_rows, tracks.images, len(chosen), per_image, 0)
        per_image //= 2
    return with_points(reconstruction, tracks, pixels, chosen, split)
