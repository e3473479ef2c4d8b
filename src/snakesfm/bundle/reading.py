"""Points and keypoints of a ``pycolmap.Reconstruction`` as arrays."""

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


def observations_of(reconstruction: pycolmap.Reconstruction) -> tuple[Array, Array, Array, Array]:
    """Points (T,3) by ascending id and, per observation, the rows (L,) of its point, image and keypoint."""
    with written_files(reconstruction) as folder:
        content = (folder / POINTS_FILE).read_bytes()
    (count,) = COUNT.unpack_from(content)
    heads, tracks, at = [], [], COUNT.size
    for _ in range(count):
        track = at + POINT.itemsize
        heads.append(content[at:track])
        at = track + ELEMENT.itemsize * COUNT.unpack_from(content, track - COUNT.size)[0]
        tracks.append(content[track:at])
    points = np.frombuffer(b"".join(heads), POINT)
    elements = np.frombuffer(b"".join(tracks), ELEMENT)
    del content, heads, tracks
    order = np.argsort(points["id"])
    lengths = points["length"].astype(np.int64)
    ends = np.cumsum(lengths)
    sorted_lengths = lengths[order]
    shifts = (ends - lengths)[order] - (np.cumsum(sorted_lengths) - sorted_lengths)
    elements = elements[np.repeat(shifts, sorted_lengths) + np.arange(len(elements))]
    point_rows = np.repeat(np.arange(len(points)), sorted_lengths)
    images, rows = elements["image"].astype(np.int64) - 1, elements["keypoint"].astype(np.int64)
    return points["xyz"][order], point_rows, images, rows


def observed_keypoints(reconstruction: pycolmap.Reconstruction, images: Array, rows: Array) -> Array:
    """Pixels (L,2) of keypoints, as the reconstruction holds them now.

    Parameters
    ----------
    images : (L,) image of each keypoint (row, not id); registered.
    rows : (L,) row of each keypoint in its image.
    """
    pixels = np.empty((len(images), 2))
    order = np.argsort(images, kind="stable")
    bounds = np.searchsorted(images[order], np.arange(int(images.max(initial=-1)) + 2))
    with written_files(reconstruction) as folder, (folder / IMAGES_FILE).open("rb") as file:
        for _ in range(COUNT.unpack(file.read(COUNT.size))[0]):
            image_id, _, count = read_image_head(file)
            keypoints = np.frombuffer(file.read(count * KEYPOINT.itemsize), KEYPOINT)["xy"]
            if image_id < len(bounds):
                mine = order[bounds[image_id - 1] : bounds[image_id]]
                pixels[mine] = keypoints[rows[mine]]
    return pixels
