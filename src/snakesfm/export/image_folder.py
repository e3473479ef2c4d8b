"""The folders ``images`` and ``masks`` next to an exported model."""

import os
import shutil
import struct
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from snakesfm.arrays import Array

UPRIGHT = (0, 1)
EXIF_MARK = b"Exif\0\0"
ORIENTATION = 0x0112
BIG_TIFF = 43
# of EXIF's types SHORT and LONG
VALUE_FORMATS = {3: "H", 4: "I"}


def place_images(target: Path, images: Path, names: Sequence[str], orientations: Array) -> None:
    """Make ``target`` show the images as the model sees them.

    If EXIF turns some images, copies of them are placed that EXIF does not turn: the model is of the pixels
    as they are stored, which is what COLMAP, 3DGS and nerfstudio read, but OpenCV and others would turn
    them.

    Parameters
    ----------
    target : what to make; an earlier one is replaced.
    images : folder of the photographs.
    names : images relative to it.
    orientations : (N,) EXIF orientation of each image.
    """
    turned = [
        name for name, value in zip(names, orientations.tolist(), strict=True) if value not in UPRIGHT
    ]
    _place(target, images, names, dict.fromkeys(turned, _write_unturned))


def place_masks(target: Path, masks: Path, names: Collection[str]) -> None:
    """Make ``target`` show masks as nerfstudio can read them: as they are, or else copies of 0 and 255.

    Parameters
    ----------
    target : what to make; an earlier one is replaced.
    masks : folder of the masks.
    names : masks relative to it.
    """
    plain = all(_is_plain_gray(masks / name) for name in names)
    _place(target, masks, names, {} if plain else dict.fromkeys(names, _write_gray))


def _place(
    target: Path, source: Path, names: Collection[str], writers: Mapping[str, Callable[[Path, Path], None]]
) -> None:
    """Make ``target`` one link to ``source``, or a folder of links if some files have ``writers``.

    Links are relative where both lie under one top folder, so that they can be moved together; where none
    can be made, files are copied.
    """
    # the source may be given as the very link that is made here
    source = source.resolve()
    if target.is_symlink() or target.is_file():
        target.unlink()
    elif target.is_dir() and target.resolve() == source:
        return
    elif target.is_dir():
        shutil.rmtree(target)
    if not writers and _link(target, source):
        return
    for name in names:
        place = target / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if name in writers:
            writers[name](source / name, place)
        elif not _link(place, source / name):
            shutil.copyfile(source / name, place)


def _link(link: Path, source: Path) -> bool:
    """Make a symbolic link; False where the file system has none."""
    source, place = source.resolve(), link.parent.resolve()
    shared = os.path.commonpath([source, place])
    text = str(source) if shared == os.path.sep else os.path.relpath(source, place)
    try:
        link.symlink_to(text)
    except OSError:
        return False
    return True


def _is_plain_gray(mask: Path) -> bool:
    """Whether nerfstudio reads a mask as snakesfm does.

    It refuses colours, takes the numbers of a palette for gray, and some versions misread other depths.
    """
    from PIL import Image

    with Image.open(mask) as image:
        return image.mode == "L" and not image.has_transparency_data


def _write_gray(source: Path, place: Path) -> None:
    """Write a mask of 0 and 255 in 8 bits."""
    from PIL import Image

    from snakesfm.ingest.read import read_not_black

    content = BytesIO()
    Image.fromarray(np.where(read_not_black(source), 255, 0).astype(np.uint8)).save(content, "PNG")
    place.write_bytes(content.getvalue())


def _write_unturned(source: Path, place: Path) -> None:
    """Copy an image with an EXIF orientation of 1, and all else, its pixels too, byte for byte."""
    from PIL import Image

    content = bytearray(source.read_bytes())
    with Image.open(source) as image:
        kind = image.format
        block = bytes(image.info.get("exif", b"")).removeprefix(EXIF_MARK)
    # a TIFF file is itself what other files hold as their EXIF
    start = 0 if kind == "TIFF" else content.find(block) if block else -1
    # orientation may stand elsewhere (XMP), where hardly a reader looks
    if start >= 0:
        _set_upright(content, start)
        if kind == "PNG":
            end = start + len(block)
            content[end : end + 4] = zlib.crc32(content[start - 4 : end]).to_bytes(4, "big")
    place.write_bytes(content)


def _set_upright(content: bytearray, start: int) -> None:
    """Set the orientation in the first directory of the TIFF or BigTIFF structure at ``start`` to 1."""
    order = "<" if content[start : start + 2] == b"II" else ">"
    (magic,) = struct.unpack_from(f"{order}H", content, start + 2)
    # of where the directory is, of its length and of an entry, and where the entry has its value
    at, offset, length, size, value = (8, "Q", "Q", 20, 12) if magic == BIG_TIFF else (4, "I", "H", 12, 8)
    (directory,) = struct.unpack_from(order + offset, content, start + at)
    (entries,) = struct.unpack_from(order + length, content, start + directory)
    first = start + directory + struct.calcsize(order + length)
    for entry in range(first, first + size * entries, size):
        tag, kind = struct.unpack_from(f"{order}HH", content, entry)
        if tag == ORIENTATION and kind in VALUE_FORMATS:
            struct.pack_into(order + VALUE_FORMATS[kind], content, entry + value, 1)
