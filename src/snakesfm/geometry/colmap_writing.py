"""Points, observations and keypoints for a reconstruction of cameras and images, by COLMAP's files."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_files import (
    COUNT,
    ELEMENT,
    IMAGES_FILE,
    KEYPOINT,
    NO_POINT,
    POINT,
    POINTS_FILE,
    read_image_head,
    written_files,
)
from snakesfm.grouping import rows_of_each

NO_ERROR = -1.0
"""What pycolmap holds for a point whose reprojection error was not computed."""


def with_observations(
    reconstruction: pycolmap.Reconstruction,
    keypoints: Sequence[Array],
    points: Array,
    offsets: Array,
    image_ids: Array,
    keypoint_ids: Array,
    colors: Array | int = 0,
    errors_px: Array | float = NO_ERROR,
) -> pycolmap.Reconstruction:
    """A reconstruction with points and keypoints beside the cameras, rigs, frames and images of another.

    Point k gets id k + 1.

    Parameters
    ----------
    reconstruction : without points and keypoints; image k has id k + 1, and a pose, or it is left out.
    keypoints : per image (K_i,2), pixels.
    points, colors, errors_px : (T,3) float64, (T,3) uint8 RGB, (T,) mean reprojection error in pixels.
    offsets : (T+1,) int64, rows ``offsets[k]:offsets[k+1]`` of the next two belong to point k.
    image_ids, keypoint_ids : (L,) int, row of the image, which the reconstruction holds, and of the
        keypoint in it.

    Raises
    ------
    ConfigError : the installed pycolmap has binary files of another layout.
    """
    heads = np.empty(len(points), POINT)
    heads["id"] = np.arange(len(points)) + 1
    heads["xyz"], heads["color"], heads["error"] = points, colors, errors_px
    heads["length"] = np.diff(offsets)
    tracks = np.empty(len(image_ids), ELEMENT)
    tracks["image"], tracks["keypoint"] = image_ids + 1, keypoint_ids
    with written_files(reconstruction) as folder:
        _write_points(folder / POINTS_FILE, heads, tracks)
        _write_images(folder / IMAGES_FILE, keypoints, tracks, np.repeat(heads["id"], np.diff(offsets)))
        return pycolmap.Reconstruction(str(folder))


def keypoints_of_observations(image_ids: Array, pixels: Array, count: int) -> tuple[list[Array], Array]:
    """Keypoints that are observations each, in the order of these.

    Parameters
    ----------
    image_ids, pixels : (L,) and (L,2), image of each observation and its pixel.
    count : number of images.

    Returns
    -------
    Per image (K_i,2) pixels, and per observation the row (L,) int64 of its keypoint.
    """
    keypoints, rows = [np.zeros((0, 2))] * count, np.empty(len(image_ids), np.int64)
    for image, mine in rows_of_each(image_ids):
        keypoints[image], rows[mine] = pixels[mine], np.arange(len(mine))
    return keypoints, rows


def _write_points(path: Path, heads: Array, tracks: Array) -> None:
    """Write points3D.bin, in which each point is followed by its track."""
    sizes = np.empty((len(heads), 2), np.int64)
    sizes[:, 0] = POINT.itemsize
    sizes[:, 1] = heads["length"] * ELEMENT.itemsize
    in_head = np.repeat(np.tile([True, False], len(heads)), sizes.ravel())
    content = np.empty(len(in_head), np.uint8)
    content[in_head] = heads.view(np.uint8)
    content[~in_head] = tracks.view(np.uint8)
    with path.open("wb") as file:
        file.write(COUNT.pack(len(heads)))
        file.write(content.data)


def _write_images(path: Path, keypoints: Sequence[Array], tracks: Array, point_ids: Array) -> None:
    """Give the images of images.bin their keypoints, and these the points (L,) of the tracks (L,)."""
    of_image = dict(rows_of_each(tracks["image"]))
    without = BytesIO(path.read_bytes())
    with path.open("wb") as file:
        number = without.read(COUNT.size)
        file.write(number)
        for _ in range(COUNT.unpack(number)[0]):
            image_id, head, _ = read_image_head(without)
            mine = of_image.get(image_id, slice(0))
            points2d = np.empty(len(keypoints[image_id - 1]), KEYPOINT)
            points2d["xy"], points2d["point"] = keypoints[image_id - 1], NO_POINT
            points2d["point"][tracks["keypoint"][mine]] = point_ids[mine]
            file.write(head)
            file.write(COUNT.pack(len(points2d)))
            file.write(points2d.tobytes())
