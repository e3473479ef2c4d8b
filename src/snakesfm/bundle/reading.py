"""Points and keypoints of a ``pycolmap.Reconstruction`` as arrays.

pycolmap hands out points, tracks and keypoints one Python object at a time, which takes over a microsecond
per observation. Its binary files (COLMAP's documentation, "Output Format") hold the same numbers to the bit
and are written and read in a tenth of that.
"""

import mmap
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
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
COUNT = struct.Struct("<Q")
IMAGE = struct.Struct("<I7dI")


def observations_of(reconstruction: pycolmap.Reconstruction) -> tuple[Array, Array, Array, Array]:
    """Points (T,3) by ascending id and, per observation, the rows (L,) of its point, image and keypoint."""
    with _written(reconstruction) as folder:
        content = np.fromfile(folder / "points3D.bin", np.uint8)
    buffer, at = content.data, COUNT.size
    starts = np.empty(COUNT.unpack_from(buffer)[0], dtype=np.int64)
    for k in range(len(starts)):
        starts[k] = at
        at += POINT.itemsize + 8 * COUNT.unpack_from(buffer, at + POINT.itemsize - 8)[0]
    heads = starts[:, None] + np.arange(POINT.itemsize)
    points = content[heads].view(POINT).reshape(-1)
    between = np.ones(len(content), dtype=bool)
    between[: COUNT.size] = False
    between[heads] = False
    elements = content[between].view("<u4").reshape(-1, 2).astype(np.int64)
    order = np.argsort(points["id"])
    lengths = points["length"].astype(np.int64)
    ends = np.cumsum(lengths)
    sorted_lengths = lengths[order]
    shifts = (ends - lengths)[order] - (np.cumsum(sorted_lengths) - sorted_lengths)
    elements = elements[np.repeat(shifts, sorted_lengths) + np.arange(len(elements))]
    point_rows = np.repeat(np.arange(len(points)), sorted_lengths)
    return points["xyz"][order], point_rows, elements[:, 0] - 1, elements[:, 1]


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
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        at = COUNT.size
        for _ in range(COUNT.unpack_from(content)[0]):
            image = IMAGE.unpack_from(content, at)[0] - 1
            at = content.find(b"\0", at + IMAGE.size) + 1
            (count,) = COUNT.unpack_from(content, at)
            at += COUNT.size
            if image + 1 < len(bounds):
                mine = order[bounds[image] : bounds[image + 1]]
                keypoints = np.frombuffer(content, KEYPOINT, count, at)["xy"]
                pixels[mine] = keypoints[rows[mine]]
                del keypoints
            at += count * KEYPOINT.itemsize
        content.close()
    return pixels


@contextmanager
def _written(reconstruction: pycolmap.Reconstruction) -> Iterator[Path]:
    """A folder that holds the reconstruction's binary files."""
    with tempfile.TemporaryDirectory(prefix="snakesfm.") as name:
        reconstruction.write_binary(name)
        yield Path(name)
