"""The folder ``images`` beside an exported model."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
UPRIGHT = (0, 1)
JPEG_QUALITY = 95


def place_images(target: Path, images: Path, names: Sequence[str], orientations: Array) -> None:
    """Make ``target`` show the images as the model sees them.

    It is one link to ``images``, relative where both lie under one top folder, so that they can be moved
    together; a copy where links cannot be made. If EXIF turned some images, it is a folder of links with
    upright copies of those, because most readers of models ignore EXIF.

    Parameters
    ----------
    target : what to make; an earlier one is replaced.
    images : folder of the photographs.
    names : images relative to it; the files that are placed where one link does not do.
    orientations : (N,) EXIF orientation of each image.
    """
    if target.is_symlink() or target.is_file():
        target.unlink()
    elif target.is_dir() and target.resolve() == images.resolve():
        return
    elif target.is_dir():
        shutil.rmtree(target)
    turned = {
        name for name, value in zip(names, orientations.tolist(), strict=True) if value not in UPRIGHT
    }
    if not turned and _link(target, images):
        return
    for name in names:
        place = target / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if name in turned:
            _write_upright(images / name, place)
        elif not _link(place, images / name):
            shutil.copyfile(images / name, place)


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


def _write_upright(source: Path, place: Path) -> None:
    from PIL import Image, ImageOps

    with Image.open(source) as image:
        upright = ImageOps.exif_transpose(image)
        options = {"quality": JPEG_QUALITY, "subsampling": 0} if image.format == "JPEG" else {}
        upright.save(place, format=image.format, **options)
