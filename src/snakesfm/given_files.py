"""Files of a COLMAP model and of known intrinsics: where they lie in a folder, and whether they look right.

The Snakefile asks this while it is parsed, so nothing is read but the beginning of a file.
"""

import struct
from pathlib import Path

MODEL_PARTS = ("cameras", "images", "points3D")
# beside them since COLMAP 3.12
LATER_PARTS = ("frames", "rigs")
MODEL_SUFFIXES = (".bin", ".txt")
MODEL_PLACES = (".", "sparse/0", "sparse", "0")
CAMERAS_FILES = ("cameras.bin", "cameras.txt", "K.txt")
NO_MODEL = (
    "does not contain a COLMAP model: give a folder with cameras, images and points3D as .bin or .txt, or "
    "the folder above its sparse/0."
)
NO_CAMERAS_FILE = f"contains none of {', '.join(CAMERAS_FILES)}: give the file's path."
NO_CAMERAS = "is neither a COLMAP cameras file nor a 3x3 matrix"
# a camera of cameras.bin: id, model, size and 3 to 16 parameters
FEWEST_CAMERA_BYTES = 48
MOST_CAMERA_BYTES = 152


def find_model_folder(folder: Path) -> Path | None:
    """``folder`` or its sparse/0, sparse or 0, whichever has cameras, images and points3D, or None."""
    for place in MODEL_PLACES:
        for suffix in MODEL_SUFFIXES:
            if all((folder / place / f"{part}{suffix}").is_file() for part in MODEL_PARTS):
                return folder / place
    return None


def list_model_files(folder: Path) -> list[Path]:
    """The files of the COLMAP model that :func:`find_model_folder` finds, sorted; none without a model."""
    place = find_model_folder(folder)
    if place is None:
        return []
    names = [f"{part}{suffix}" for part in (*MODEL_PARTS, *LATER_PARTS) for suffix in MODEL_SUFFIXES]
    return sorted(file for name in names if (file := place / name).is_file())


def find_cameras_file(path: Path) -> Path | None:
    """The file of known intrinsics that a path names or, as a folder, holds; None where there is none."""
    if path.is_dir():
        return next((path / name for name in CAMERAS_FILES if (path / name).is_file()), None)
    return path if path.is_file() else None


def looks_like_cameras(file: Path) -> bool:
    """Whether a file begins as a cameras.txt or 3x3 matrix does, or is as large as its cameras.bin says.

    Raises
    ------
    OSError : it cannot be read.
    """
    try:
        if file.suffix == ".bin":
            with file.open("rb") as binary:
                (count,) = struct.unpack("<Q", binary.read(8))
            size = file.stat().st_size - 8
            return bool(count * FEWEST_CAMERA_BYTES <= size <= count * MOST_CAMERA_BYTES)
        with file.open(encoding="utf-8-sig") as text:
            lines = (line.split() for line in text)
            words = next((line for line in lines if line and not line[0].startswith("#")), [])
        if len(words) == 3:
            return all(map(_is_number, words))
        # without a line of content there is no camera, which the job that reads the file says
        return not words or (len(words) >= 5 and all(_is_number(words[column]) for column in (0, 2, 3)))
    except (UnicodeDecodeError, struct.error):
        return False


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
