"""Global search for one focal length at a time by the epipolar errors of its pairs."""

import numpy as np

from snakesfm.arrays import Array
from snakesfm.calibration.condensed import CondensedPairs, fit_essential
from snakesfm.calibration.epipolar import rows_of_cameras

GRID_SIZE = 14
CAP = 4.0


def scan_focals(pairs: CondensedPairs, focals: Array, free: Array, low: Array, high: Array) -> Array:
    """Focal lengths (C,) in pixels, each moved to where its pairs agree best, the others held.

    Parameters as in ``votes.vote_focals``. For each value of a logarithmic grid and the present one, every
    pair gets its best essential matrix; what counts is how much its cost exceeds that pair's own minimum
    over the grid, softened so that a wrong pair cannot outvote the others.
    """
    focals = np.array(focals, dtype=np.float64)
    for camera, rows in enumerate(rows_of_cameras(pairs.cameras, len(focals))):
        if not free[camera] or not len(rows):
            continue
        own = pairs.take(rows)
        grid = np.append(np.geomspace(low[camera], high[camera], GRID_SIZE), focals[camera])
        trials = np.where(own.cameras[:, None] == camera, grid[None, :, None], focals[own.cameras][:, None])
        units = trials / own.scales[:, None, None]
        costs = fit_essential(own, units).costs
        excess = np.log1p((costs - costs.min(axis=1, keepdims=True)) / CAP).sum(axis=0)
        focals[camera] = grid[np.argmin(excess)]
    return focals
