"""Points and keypoints of a ``pycolmap.Reconstruction`` as arrays.

pycolmap hands out points, tracks and keypoints one Python object at a time, which takes over a microsecond
per observation. Its binary files (COLMAP's documentation, "Output Format") hold the same numbers to the bit
and are written and read in a tenth of that.
"""

import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2  # noqa: F401 - must be loaded before pycolmap, whose PNG library clashes otherwise
import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[Any]

POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
COUNT = struct.Struct("<Q")
IMAGE = struct.Struct("<I7dI")


def observations_of(reconstruction: pycolmap.Reconstruction) -> tuple[Array, Array, Array, Array]:
    """Points (T,3) by ascending id and, per observation, the rows (L,) of its point, image and keypoint."""
    with _written(reconstruction) as folder:
        content = (folder / "points3D.bin").read_bytes()
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
    with _written(reconstruction) as folder, (folder / "images.bin").open("rb") as file:
        for _ in range(COUNT.unpack(file.read(COUNT.size))[0]):
            image = IMAGE.unpack(file.read(IMAGE.size))[0] - 1
            # the name, which ends with a zero
            while file.read(1) != b"\0":
                pass
            (count,) = COUNT.unpack(file.read(COUNT.size))
            keypoints = np.frombuffer(file.read(count * KEYPOINT.itemsize), KEYPOINT)["xy"]
            if image + 1 < len(bounds):
                mine = order[bounds[image] : bounds[image + 1]]
                pixels[mine] = keypoints[rows[mine]]
    return pixels


@contextmanager
def _written(reconstruction: pycolmap.Reconstruction) -> Iterator[Path]:
    """A folder that holds the reconstruction's binary files."""
    with tempfile.TemporaryDirectory(prefix="snakesfm.") as name:
        reconstruction.write_binary(name)
        yield Path(name)
