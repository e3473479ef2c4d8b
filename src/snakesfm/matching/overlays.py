"""Matches on overlays: what all images show at one place, as a time stamp, a logo or a car's bonnet.

Such matches stand still while the camera moves. They agree with each other perfectly, on no motion at all,
so that neither the relative poses nor the cycles of the view graph refuse them.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from snakesfm.arrays import Array

CELL_PX = 8
# between two images of an overlay, and what its keypoints may move where neighbouring pixels change
STILL_PX, DROPPED_PX = 1.0, 3.0
# a pair that stands still as a whole shows one view twice, and where the rest hardly moves (slow videos),
# what is far stands still too: neither says anything of an overlay
WHOLE = 0.9
MOVED_PX = 10.0
MIN_MATCHES = 15
MIN_PAIRS = 3
# where a cell recurs in enough pairs there is an overlay, and its margins are seen less often
MARGIN = 1 / 6
NEIGHBOURS = np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), -1).reshape(-1, 2)


def find_overlay_cells(pairs: Iterable[tuple[tuple[int, int], Array, Array]], share: float) -> Array:
    """Cells in which matches stand still, in many pairs of images of which all else moves.

    Parameters
    ----------
    pairs : per pair the size (width, height) that both images have in detector pixels, and the matched
        keypoints (K,2) of either.
    share : of the pairs of a size, in which some cell must recur.

    Returns
    -------
    Array
        (S,4) int32, width and height of the images, column and row of a cell of 8 detector pixels.
    """
    tallies: dict[tuple[int, int], Array] = {}
    counts: dict[tuple[int, int], int] = {}
    for size, first, second in pairs:
        if len(first) < MIN_MATCHES:
            continue
        still = _stand_still(first, second, STILL_PX)
        moved = np.linalg.norm(first[~still] - second[~still], axis=1)
        if still.mean() > WHOLE or np.median(moved) < MOVED_PX:
            continue
        counts[size] = counts.get(size, 0) + 1
        tally = tallies.setdefault(size, np.zeros(_grid_of(size), np.int32))
        near = (_cells_of(first[still])[:, None] + NEIGHBOURS).reshape(-1, 2)
        near = np.unique(near.clip(0, np.array(tally.shape) - 1), axis=0)
        tally[near[:, 0], near[:, 1]] += 1
    rows = [np.zeros((0, 4), np.int32)]
    for size, tally in sorted(tallies.items()):
        if tally.max() >= max(MIN_PAIRS, share * counts[size]):
            cells = np.argwhere(tally >= max(MIN_PAIRS, MARGIN * share * counts[size]))
            rows.append(np.hstack([np.tile(size, (len(cells), 1)), cells]).astype(np.int32))
    return np.concatenate(rows)


def cover_images(cells: Array) -> dict[tuple[int, int], Array]:
    """Which cells (columns, rows) bool an overlay covers, by the width and height of images.

    Parameters
    ----------
    cells : of :func:`find_overlay_cells`.
    """
    covered = {}
    for size in np.unique(cells[:, :2], axis=0).tolist():
        own = cells[(cells[:, :2] == size).all(axis=1), 2:]
        grid = np.zeros(_grid_of(size), dtype=bool)
        grid[own[:, 0], own[:, 1]] = True
        covered[size[0], size[1]] = grid
    return covered


def find_moving_matches(
    covered: Mapping[tuple[int, int], Array], sizes: Array, first: Array, second: Array
) -> Array:
    """Which matches (K,) of a pair do not stand still in a cell of an overlay.

    Parameters
    ----------
    covered : of :func:`cover_images`.
    sizes : (2,2) width and height of the two images in detector pixels.
    first, second : (K,2) matched keypoints.
    """
    grid = covered.get((int(sizes[0, 0]), int(sizes[0, 1])))
    if grid is None or (sizes[0] != sizes[1]).any():
        return np.ones(len(first), dtype=bool)
    at = _cells_of(first).clip(0, np.array(grid.shape) - 1)
    still: Array = grid[at[:, 0], at[:, 1]] & _stand_still(first, second, DROPPED_PX)
    return ~still


def _stand_still(first: Array, second: Array, limit_px: float) -> Array:
    still: Array = np.abs(first - second).max(axis=1) < limit_px
    return still


def _cells_of(keypoints: Array) -> Array:
    cells: Array = np.floor(keypoints / CELL_PX).astype(np.int64)
    return cells


def _grid_of(size: Any) -> tuple[int, int]:
    return int(size[0]) // CELL_PX + 1, int(size[1]) // CELL_PX + 1
