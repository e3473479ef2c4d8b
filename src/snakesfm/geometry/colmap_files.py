"""Layout of COLMAP's binary files that hold points and observations: points3D.bin and images.bin.

pycolmap takes and hands out points, tracks and keypoints one Python object at a time, which takes over a
microsecond per observation. Its binary files (COLMAP's documentation, "Output Format") hold the same
numbers to the bit and are written and read in a tenth of that.
"""

import errno
import os
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from snakesfm.errors import ConfigError
from snakesfm.geometry.colmap_binding import pycolmap

POINTS_FILE = "points3D.bin"
IMAGES_FILE = "images.bin"

COUNT = struct.Struct("<Q")
POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""A point of points3D.bin; ``length`` ELEMENTs follow it."""
ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
IMAGE = struct.Struct("<I7dI")
"""An image of images.bin: id, pose, camera; its name with a zero at its end and its keypoints follow."""
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
NO_POINT = np.iinfo(np.uint64).max
"""The point of a KEYPOINT that observes none."""

OTHER_LAYOUT = (
    "pycolmap {version} writes another {file} than snakesfm knows: run 'pip install -c constraints.txt .' "
    "in snakesfm's folder."
)


def lack_of_space(folder: str | Path) -> OSError:
    """The error of a folder without room for what pycolmap was to write there."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


@contextmanager
def written_files(reconstruction: pycolmap.Reconstruction) -> Iterator[Path]:
    """A folder for temporary files that holds the reconstruction's binary files; deleted at the end.

    Raises
    ------
    ConfigError : the installed pycolmap writes files of another layout.
    OSError : there is no room for them, or for what the caller writes; it names the temporary folder.
    """
    check_layout()
    try:
        with tempfile.TemporaryDirectory(prefix="snakesfm.") as name:
            reconstruction.write_binary(name)
            yield Path(name)
    except OSError as error:
        raise OSError(error.errno, error.strerror, tempfile.gettempdir()) from error
    except struct.error as error:
        # where there is no more room pycolmap leaves its files cut off without a word
        raise lack_of_space(tempfile.gettempdir()) from error


def read_image_head(file: BinaryIO) -> tuple[int, bytes, int]:
    """Id of the next image of images.bin, its bytes up to its keypoints' count, and that count.

    Raises
    ------
    struct.error : the file ends before.
    """
    head = file.read(IMAGE.size)
    image_id: int = IMAGE.unpack(head)[0]
    name = bytearray()
    while (byte := file.read(1)) not in (b"\0", b""):
        name += byte
    (count,) = COUNT.unpack(file.read(COUNT.size))
    return image_id, head + name + byte, count


@cache
def check_layout() -> None:
    """Compare what pycolmap writes of a model of one point with the layout above.

    Raises
    ------
    ConfigError : they differ.
    OSError : there is no room for them; it names the temporary folder.
    """
    pixel, position, color, error, name = (1.5, 2.5), (3.0, 4.0, 5.0), (6, 7, 8), 0.25, "é .jpg"
    camera_id, image_id, point_id = 2, 3, 4
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=camera_id, model="PINHOLE", width=8, height=8, params=[8.0, 8.0, 4.0, 4.0]
    )
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name=name, keypoints=np.array([pixel]), camera_id=camera_id, image_id=image_id)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array(position)))
    track = pycolmap.Track([pycolmap.TrackElement(image_id, 0)])
    point = pycolmap.Point3D(
        xyz=np.array(position), color=np.array(color, np.uint8), error=error, track=track
    )
    model.add_point3D_with_id(point_id, point)
    one = COUNT.pack(1)
    head = IMAGE.pack(image_id, 1.0, 0.0, 0.0, 0.0, *position, camera_id) + name.encode() + b"\0"
    known = {
        POINTS_FILE: (
            one
            + np.array((point_id, position, color, error, 1), POINT).tobytes()
            + np.array((image_id, 0), ELEMENT).tobytes()
        ),
        IMAGES_FILE: one + head + one + np.array((pixel, point_id), KEYPOINT).tobytes(),
    }
    with tempfile.TemporaryDirectory(prefix="snakesfm.") as folder:
        model.write_binary(folder)
        for file, content in known.items():
            written = (Path(folder) / file).read_bytes()
            # a disk without a free block holds nothing of so short a file
            if not written:
                raise lack_of_space(tempfile.gettempdir())
            if written != content:
                raise ConfigError(OTHER_LAYOUT.format(version=pycolmap.__version__, file=file))
