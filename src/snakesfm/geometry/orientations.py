"""Images as their EXIF orientation shows them: networks do not know a picture that lies on its side.

Sizes are width and height as stored; places have the first pixel's centre at (0.5, 0.5).
"""

import numpy as np

from snakesfm.arrays import Array

# an orientation swaps the sides, or not, and then mirrors along x and y, or not
SWAPPED, MIRRORED_X, MIRRORED_Y = (5, 6, 7, 8), (2, 3, 6, 7), (3, 4, 7, 8)


def show_pixels(pixels: Array, orientation: int) -> Array:
    """An image (H,W,...) as an EXIF orientation 1..8 shows it."""
    if orientation in SWAPPED:
        pixels = pixels.swapaxes(0, 1)
    if orientation in MIRRORED_X:
        pixels = pixels[:, ::-1]
    if orientation in MIRRORED_Y:
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def store_pixels(pixels: Array, orientation: int) -> Array:
    """An image (H,W,...) as stored, of one that an EXIF orientation 1..8 shows."""
    if orientation in MIRRORED_Y:
        pixels = pixels[::-1]
    if orientation in MIRRORED_X:
        pixels = pixels[:, ::-1]
    if orientation in SWAPPED:
        pixels = pixels.swapaxes(0, 1)
    return np.ascontiguousarray(pixels)


def shown_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Width and height of an image as shown."""
    return size[::-1] if orientation in SWAPPED else size


def show_places(places: Array, size: tuple[int, int], orientation: int) -> Array:
    """Where places (N,2) of an image as stored are in the image as shown."""
    swapped = places[:, ::-1] if orientation in SWAPPED else places
    return _mirror(swapped, size, orientation)


def store_places(places: Array, size: tuple[int, int], orientation: int) -> Array:
    """Where places (N,2) of an image as shown are in the image as stored."""
    mirrored = _mirror(places, size, orientation)
    return mirrored[:, ::-1] if orientation in SWAPPED else mirrored


def _mirror(places: Array, size: tuple[int, int], orientation: int) -> Array:
    """Places (N,2) of an image as shown, mirrored as its orientation says."""
    mirrored = [orientation in MIRRORED_X, orientation in MIRRORED_Y]
    opposite = np.array(shown_size(size, orientation), places.dtype) - places
    return np.where(mirrored, opposite, places)
