"""Masks: which parts of the images keypoints are wanted of.

A mask is black where an image shows what is not to be used, such as sky, water, people or a turntable. That
of ``a/b.jpg`` is ``a/b.jpg.png`` in the folder of masks, as in COLMAP; ``a/b.png`` does as well.
"""

from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from snakesfm.errors import ConfigError
from snakesfm.ingest.discover import list_images

if TYPE_CHECKING:
    from numpy.typing import NDArray

# a mask may have another size than its image, but must show the same
MAX_ASPECT_DIFFERENCE = 0.01


def find_masks(folder: Path, images: Iterable[str]) -> dict[str, Path]:
    """The mask of each image that has one, by the image's name.

    Parameters
    ----------
    folder : of the masks, searched at any depth.
    images : POSIX paths relative to the image folder.

    Raises
    ------
    ConfigError : the folder cannot be listed.
    """
    there = set(list_images(folder))
    found = {}
    for image in images:
        for name in (f"{image}.png", str(PurePosixPath(image).with_suffix(".png"))):
            if name in there:
                found[image] = folder / name
                break
    return found


def read_mask(path: Path, size: tuple[int, int]) -> "NDArray[Any]":
    """Where keypoints are wanted, (H,W) bool, of an image of a width and height.

    The mask may be larger or smaller than the image.

    Raises
    ------
    ConfigError : it cannot be decoded, or its aspect is another than the image's.
    """
    from snakesfm.errors import ImageError
    from snakesfm.ingest.read import read_image

    try:
        gray = read_image(path).gray
    except ImageError as error:
        raise ConfigError(f"A mask cannot be used: {error}") from None
    height, width = gray.shape
    if abs(width * size[1] / (height * size[0]) - 1.0) > MAX_ASPECT_DIFFERENCE:
        raise ConfigError(
            f"The mask {path} has {width} x {height} pixels but its image {size[0]} x {size[1]}: give one "
            "that shows the whole image, turned as the image is stored."
        )
    wanted: NDArray[Any] = gray > 0
    return wanted


def select_unmasked(wanted: "NDArray[Any]", keypoints: "NDArray[Any]", width: float, height: float) -> Any:
    """Which keypoints (N,2), in an image of a width and height, lie where a mask (H,W) is true."""
    rows, columns = wanted.shape
    x = (keypoints[:, 0] * (columns / width)).astype(int).clip(0, columns - 1)
    y = (keypoints[:, 1] * (rows / height)).astype(int).clip(0, rows - 1)
    return wanted[y, x]
