"""Points and observations for a reconstruction of cameras and images, by COLMAP's binary files."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_files import (
    COUNT,
    ELEMENT,
    IMAGES_FILE,
    KEYPOINT,
    POINT,
    POINTS_FILE,
    read_image_head,
    written_files,
)

Array = NDArray[Any]


def with_observations(
    reconstruction: pycolmap.Reconstruction,
    points: Array,
    colors: Array,
    errors_px: Array,
    offsets: Array,
    image_ids: Array,
    keypoints: Array,
) -> pycolmap.Reconstruction:
    """A reconstruction with points and observations beside the cameras, rigs, frames and images of another.

    Point k gets id k + 1. The points2D of an image are its observations, in the order of the points.

    Parameters
    ----------
    reconstruction : without points and keypoints; image k has id k + 1.
    points, colors, errors_px : (T,3) float64, (T,3) uint8 RGB, (T,) mean reprojection error in pixels.
    offsets, image_ids, keypoints : (T+1,), (L,), (L,2): observations of the points, in original pixels, by
        images that the reconstruction holds.

    Raises
    ------
    ConfigError : the installed pycolmap has binary files of another layout.
    """
    counts = np.bincount(image_ids, minlength=max(reconstruction.reg_image_ids(), default=0))
    starts = np.concatenate([[0], np.cumsum(counts)])
    order = np.argsort(image_ids, kind="stable")
    tracks = np.empty(len(image_ids), ELEMENT)
    tracks["image"] = image_ids + 1
    tracks["keypoint"][order] = np.arange(len(image_ids)) - np.repeat(starts[:-1], counts)
    heads = np.empty(len(points), POINT)
    heads["id"] = np.arange(len(points)) + 1
    heads["xyz"], heads["color"], heads["error"] = points, colors, errors_px
    heads["length"] = np.diff(offsets)
    points2d = np.empty(len(image_ids), KEYPOINT)
    points2d["xy"] = keypoints[order]
    points2d["point"] = np.repeat(heads["id"], np.diff(offsets))[order]
    with written_files(reconstruction) as folder:
        _write_points(folder / POINTS_FILE, heads, tracks)
        _write_images(folder / IMAGES_FILE, points2d, starts)
        return pycolmap.Reconstruction(str(folder))


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


def _write_images(path: Path, points2d: Array, starts: Array) -> None:
    """Give the images of images.bin their keypoints: rows ``starts[k]:starts[k+1]`` are image k's."""
    without = BytesIO(path.read_bytes())
    with path.open("wb") as file:
        number = without.read(COUNT.size)
        file.write(number)
        for _ in range(COUNT.unpack(number)[0]):
            image_id, head, _ = read_image_head(without)
            mine = points2d[starts[image_id - 1] : starts[image_id]]
            file.write(head)
            file.write(COUNT.pack(len(mine)))
            file.write(mine.tobytes())
