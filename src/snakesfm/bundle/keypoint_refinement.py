"""Refinement of a reconstruction's keypoints by aligning them to each other in the images."""

from collections.abc import Callable, Sequence

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.alignment import (
    AlignmentSettings,
    GrayImage,
    align_observations,
    choose_templates,
)
from snakesfm.bundle.image_sources import ImageSource
from snakesfm.bundle.reading import read_tracks_and_pixels
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import rows_of_each

MIN_ALIGNED_SHARE = 0.75
"""Where fewer of the observations can be aligned, the image or scene is blurred or of changing light."""
STEP_PX = 1.0
"""How far apart the points are whose projections give the warps."""


def most_share_a_camera(camera_ids: Array) -> bool:
    """Whether more than half of the images (camera ids (N,)) have a camera in common with another image.

    Photographs of many cameras differ in light, season and processing, which moves what pixels agree on.
    """
    _, cameras, counts = np.unique(camera_ids, return_inverse=True, return_counts=True)
    return bool(np.mean(counts[cameras] > 1) > 0.5)


def refine_by_sources(
    reconstruction: pycolmap.Reconstruction, sources: Sequence[ImageSource], blurred: Sequence[int]
) -> None:
    """Refine keypoints in the images of each source in turn; ``blurred`` as in :func:`refine_keypoints`."""
    for source in sources:
        source.report(
            *refine_keypoints(reconstruction, source.read_gray, source.scales, source.settings, blurred)
        )
        source.release()


def refine_keypoints(
    reconstruction: pycolmap.Reconstruction,
    read_gray: Callable[[int], GrayImage | None],
    gray_scales: Array,
    settings: AlignmentSettings,
    blurred: Sequence[int] = (),
) -> tuple[int, int]:
    """Align the observations of every point to the most central one, and move the image's keypoints there.

    An observation that cannot be aligned does not show its point: it is dropped, where most others of its
    image and of the model can be.

    Parameters
    ----------
    reconstruction : changed in place: keypoints and observations.
    read_gray : gives image k (row, not id), or None where there are no pixels.
    gray_scales : (N,) how many of the keypoints' pixels a pixel of each gray image is wide, at most.
    settings : how.
    blurred : rows of the images to whose observations others are aligned only where a point has no other.

    Returns
    -------
    How many observations were aligned or are templates, and how many there are.
    """
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    point_of, images, rows = tracks.point_rows, tracks.images, tracks.rows
    if not len(images):
        return 0, 0
    offsets = np.searchsorted(point_of, np.arange(len(tracks.points) + 1))
    directions, sizes, tangents = _views(reconstruction, tracks.points, point_of, images, offsets)
    inside = _patch_inside(reconstruction, images, pixels, gray_scales, settings.radius_px)
    chosen = choose_templates(directions, sizes, inside, np.isin(images, blurred), offsets)
    moved, aligned = align_observations(
        read_gray, images, pixels, tangents, chosen[point_of], inside, settings
    )
    drop = _droppable(images, aligned)
    found = reconstruction.images
    for row in np.nonzero((moved != pixels).any(axis=1))[0].tolist():
        found[int(images[row]) + 1].point2D(int(rows[row])).xy = moved[row]
    for image, row in zip(images[drop].tolist(), rows[drop].tolist(), strict=True):
        if found[image + 1].point2D(row).has_point3D():
            reconstruction.delete_observation(image + 1, row)
    return int(aligned.sum()), len(aligned)


def _droppable(images: Array, aligned: Array) -> Array:
    """Observations (L,) bool that do not look like their point, in images and scenes where most do."""
    if aligned.mean() < MIN_ALIGNED_SHARE:
        return np.zeros(len(aligned), dtype=bool)
    counts = np.maximum(np.bincount(images), 1)
    shares = np.bincount(images, weights=aligned, minlength=len(counts)) / counts
    return ~aligned & (shares[images] >= MIN_ALIGNED_SHARE)


def _views(
    reconstruction: pycolmap.Reconstruction, points: Array, point_of: Array, images: Array, offsets: Array
) -> tuple[Array, Array, Array]:
    """Rays (L,3), log sizes (L,) and tangents (L,2,2) of observations; planes face the cameras."""
    count = int(images.max()) + 1
    rotations, translations, focals = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.ones(count)
    for image in np.unique(images).tolist():
        seen = reconstruction.image(image + 1)
        pose = seen.cam_from_world()
        rotations[image], translations[image] = pose.rotation.matrix(), pose.translation
        focals[image] = reconstruction.camera(seen.camera_id).mean_focal_length()
    in_camera = np.einsum("lij,lj->li", rotations[images], points[point_of]) + translations[images]
    depths = np.linalg.norm(in_camera, axis=1)
    directions = np.einsum("lji,lj->li", rotations[images], in_camera) / depths[:, None]
    sizes = np.log(focals[images] / depths)

    normals = np.add.reduceat(directions, offsets[:-1], axis=0)
    first = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-12)
    widths = STEP_PX / np.exp(np.add.reduceat(sizes, offsets[:-1]) / np.diff(offsets))
    tangents = np.empty((len(images), 2, 2))
    center = _project(reconstruction, images, in_camera)
    for column, axis in enumerate((first, second)):
        offset = np.einsum("lij,lj->li", rotations[images], (axis * widths[:, None])[point_of])
        tangents[:, :, column] = _project(reconstruction, images, in_camera + offset) - center
    return directions, sizes, tangents


def _project(reconstruction: pycolmap.Reconstruction, images: Array, in_camera: Array) -> Array:
    """Pixels (L,2) of points (L,3) in the frames of their images' cameras."""
    cameras = np.zeros(int(images.max()) + 1, dtype=np.int64)
    for image in np.unique(images).tolist():
        cameras[image] = reconstruction.image(image + 1).camera_id
    pixels = np.full((len(images), 2), np.nan)
    for camera, rows in rows_of_each(cameras[images]):
        pixels[rows] = reconstruction.camera(camera).img_from_cam(in_camera[rows])
    return pixels


def _patch_inside(
    reconstruction: pycolmap.Reconstruction, images: Array, pixels: Array, gray_scales: Array, radius: int
) -> Array:
    """Observations (L,) bool whose patch is in the image, with a border for gradients and interpolation."""
    sizes = np.zeros((int(images.max()) + 1, 2))
    for image in np.unique(images).tolist():
        camera = reconstruction.camera(reconstruction.image(image + 1).camera_id)
        sizes[image] = camera.width, camera.height
    margins = ((radius + 3) * gray_scales[images])[:, None]
    return np.asarray(((pixels >= margins) & (pixels <= sizes[images] - margins)).all(axis=1))
