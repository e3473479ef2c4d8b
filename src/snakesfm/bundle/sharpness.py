"""Which images are blurred, by the points that they share with others."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from snakesfm.arrays import Array
from snakesfm.bundle.image_sources import ImageSource
from snakesfm.bundle.reading import read_tracks_and_pixels
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import rows_of_each

RADIUS_PX = 5
# down and right
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
# of patches of one gray value, or of one slope
LEAST_SHARPNESS = 1e-3
BLURRED_SHARE = 0.75
"""Of the sharpness at which the usual image shows a point, what a blurred one has at most."""


def find_blurred(reconstruction: pycolmap.Reconstruction, source: ImageSource) -> list[int]:
    """Rows (not ids) of the images that show their points less sharp than other images do.

    The sharpness of a patch is the energy of its second derivatives over that of its first ones, in the
    direction where this is least: motion blurs one alone, and neither brightness nor contrast changes it.
    All images of a point show one piece of surface, so an image of even surfaces is not taken for blurred.
    """
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    sharpness = np.full(len(pixels), np.nan)

    def measure(part: tuple[int, Array]) -> None:
        image, mine = part
        read = source.read_gray(image)
        if read is not None:
            sharpness[mine] = _log_sharpness(read.gray, pixels[mine] / read.scale)

    with ThreadPoolExecutor(source.settings.threads) as pool:
        # each image writes rows of its own
        list(pool.map(measure, rows_of_each(tracks.images)))
    known = np.isfinite(sharpness)
    points, images, sharpness = tracks.point_rows[known], tracks.images[known], sharpness[known]
    means = np.bincount(points, sharpness) / np.maximum(np.bincount(points), 1)
    relative = sharpness - means[points]
    levels = {image: float(np.median(relative[mine])) for image, mine in rows_of_each(images)}
    least = np.median(list(levels.values())) + np.log(BLURRED_SHARE) if levels else 0.0
    return [image for image, level in levels.items() if level < least]


def _log_sharpness(gray: Array, places: Array) -> Array:
    """Log sharpness (M,) of the patches of a gray image around places (M,2); NaN where there is none."""
    height, width = gray.shape
    steps = np.arange(-RADIUS_PX - 1, RADIUS_PX + 2)
    columns, rows = np.floor(places).astype(int).T
    inside = np.minimum(columns, rows) + steps[0] >= 0
    inside &= (columns + steps[-1] < width) & (rows + steps[-1] < height)
    patches = gray[(rows[inside, None] + steps)[:, :, None], (columns[inside, None] + steps)[:, None]]
    patches = patches.astype(np.float32)
    side = len(steps) - 2

    def beside(down: int, right: int) -> Array:
        return np.asarray(patches[:, 1 + down : 1 + down + side, 1 + right : 1 + right + side])

    ratios = []
    for down, right in DIRECTIONS:
        one, other = beside(down, right), beside(-down, -right)
        curved = np.square(2 * beside(0, 0) - one - other).sum(axis=(1, 2)) / (down**2 + right**2)
        ratios.append(curved / np.maximum(np.square(one - other).sum(axis=(1, 2)), 1.0))
    found = np.full(len(places), np.nan)
    found[inside] = np.log(np.maximum(np.min(ratios, axis=0), LEAST_SHARPNESS))
    return found
