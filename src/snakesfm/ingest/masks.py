"""Masks: the parts of the images in which keypoints are wanted.

A mask is black where an image shows what is not to be used, such as sky, water, people or a turntable. That
of ``a/b.jpg`` is ``a/b.jpg.png`` in the folder of masks, as in COLMAP; ``a/b.png`` does as well.
"""

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from snakesfm.errors import ConfigError

if TYPE_CHECKING:
    from snakesfm.arrays import Array

# a mask may have another size than its image, but must show the same
MAX_ASPECT_DIFFERENCE = 0.01


def find_mask(folder: Path, image: str) -> Path | None:
    """The mask of an image, which is named by its path relative to the image folder; None without one."""
    names = (f"{image}.png", PurePosixPath(image).with_suffix(".png"))
    return next((folder / name for name in names if (folder / name).is_file()), None)


def masks_as_large(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> dict[str, str]:
    """The masks of just their image's width and height, relative to ``folder``, by the image's name."""
    from PIL import Image

    found = {}
    for image, size in sizes.items():
        mask = find_mask(folder, image)
        if mask is not None:
            with Image.open(mask) as opened:
                if opened.size == size:
                    found[image] = mask.relative_to(folder).as_posix()
    return found


def read_mask(path: Path, size: tuple[int, int]) -> "Array":
    """Where keypoints are wanted, (H,W) bool, of an image of a width and height: where it is not black.

    A small number of an instance in 16 bits is not black. The mask may be larger or smaller than the image.

    Raises
    ------
    ConfigError : it cannot be decoded, or its aspect is another than the image's.
    """
    from snakesfm.errors import ImageError
    from snakesfm.ingest.read import read_not_black

    try:
        wanted = read_not_black(path)
    except ImageError as error:
        raise ConfigError(f"A mask cannot be used: {error}") from None
    height, width = wanted.shape
    if abs(width * size[1] / (height * size[0]) - 1.0) > MAX_ASPECT_DIFFERENCE:
        raise ConfigError(
            f"The mask {path} has {width} x {height} pixels, but its image {size[0]} x {size[1]}: give a "
            "mask of the whole image, in the orientation in which the image is stored."
        )
    return wanted
