"""Whether COLMAP's files are whole: on a full disk pycolmap leaves them cut off without a word."""

import os
from pathlib import Path

from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_files import (
    COUNT,
    ELEMENT,
    IMAGE,
    IMAGES_FILE,
    KEYPOINT,
    POINT,
    POINTS_FILE,
    lack_of_space,
)

# id, model, width and height; parameters of 8 bytes follow
CAMERA_BYTES = 24
# of one camera, and of one image
RIG_BYTES = 16
FRAME_BYTES = 84
PARAMETER_BYTES = 8
# position and colour
PLY_POINT_BYTES = 15
PLY_HEAD_END = b"end_header\n"
CHUNK_BYTES = 1 << 24


def check_binary(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Refuse binary files of a model that are shorter than what they hold.

    Raises
    ------
    OSError : the disk is full.
    """
    # COLMAP writes images and frames that have a pose, but all cameras and rigs
    images = [model.image(key) for key in model.reg_image_ids()]
    counts = [len(camera.params) for camera in model.cameras.values()]
    # of an image its name, the zero at the name's end, and the number of its keypoints
    heads = sum(IMAGE.size + len(os.fsencode(image.name)) + 1 + COUNT.size for image in images)
    sizes = {
        "cameras.bin": CAMERA_BYTES * len(counts) + PARAMETER_BYTES * sum(counts),
        "rigs.bin": RIG_BYTES * model.num_rigs(),
        "frames.bin": FRAME_BYTES * model.num_reg_frames(),
        IMAGES_FILE: heads + KEYPOINT.itemsize * sum(image.num_points2D() for image in images),
        POINTS_FILE: POINT.itemsize * model.num_points3D()
        + ELEMENT.itemsize * model.compute_num_observations(),
    }
    for name, size in sizes.items():
        if (folder / name).stat().st_size < COUNT.size + size:
            raise lack_of_space(folder)


def check_text(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Refuse text files of a model that lack a line or its end.

    Raises
    ------
    OSError : the disk is full.
    """
    lines = {
        "cameras.txt": model.num_cameras(),
        "rigs.txt": model.num_rigs(),
        "frames.txt": model.num_reg_frames(),
        "images.txt": 2 * model.num_reg_images(),
        "points3D.txt": model.num_points3D(),
    }
    for name, count in lines.items():
        if _count_lines(folder / name) < count:
            raise lack_of_space(folder)


def _count_lines(path: Path) -> int:
    """Ends of lines of a file, without those of the comments at its beginning."""
    count = 0
    with path.open("rb") as file:
        while (line := file.readline()).startswith(b"#"):
            pass
        count += line.count(b"\n")
        while chunk := file.read(CHUNK_BYTES):
            count += chunk.count(b"\n")
    return count


def check_ply(path: Path, points: int) -> None:
    """Refuse a file of so many points that is cut off.

    Raises
    ------
    OSError : the disk is full.
    """
    with path.open("rb") as file:
        head = file.read(1024).find(PLY_HEAD_END)
    if head < 0 or path.stat().st_size < head + len(PLY_HEAD_END) + PLY_POINT_BYTES * points:
        raise lack_of_space(path.parent)
