"""Global search for one focal length at a time by the true epipolar errors of its pairs."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.calibration.adjustment import (
    NOISE_FLOOR_PX,
    Each,
    correspondences_of,
    pose_of,
    refined_pose,
)
from snakesfm.calibration.epipolar import EpipolarPair
from snakesfm.two_view.sampson import cauchy_cost, sampson_errors_px

Array = NDArray[Any]
GRID_SIZE = 14
CAP = 4.0


def scan_focals(
    pairs: Sequence[EpipolarPair],
    focals: Array,
    free: Array,
    low: Array,
    high: Array,
    each: Each = map,
) -> Array:
    """Focal lengths (C,) in pixels, each moved to where its pairs agree best, the others held.

    Parameters as in ``votes.vote_focals``, and ``each`` as in ``adjustment.adjust_focals``. For each value
    of a logarithmic grid and the present one, every pair gets its best relative pose; what counts is how
    much its robust Sampson cost exceeds that pair's own minimum over the grid, softened so that a wrong
    pair cannot outvote the others.
    """
    focals = np.array(focals, dtype=np.float64)
    for camera in np.nonzero(free)[0]:
        own = [pair for pair in pairs if camera in (pair.camera_i, pair.camera_j)]
        if not own:
            continue
        grid = np.append(np.geomspace(low[camera], high[camera], GRID_SIZE), focals[camera])
        trials = np.tile(focals, (len(grid), 1))
        trials[:, camera] = grid
        excess = np.zeros(len(grid))
        for costs in each(partial(_pair_costs, trials=trials), own):
            costs -= costs.min()
            excess += np.log1p(costs / CAP)
        focals[camera] = grid[np.argmin(excess)]
    return focals


def _pair_costs(pair: EpipolarPair, trials: Array) -> Array:
    """The pair's costs (G,) with each row of focal lengths (G,C)."""
    return np.array([_pair_cost(pair, focals) for focals in trials])


def _pair_cost(pair: EpipolarPair, focals: Array) -> float:
    """Robust cost of a pair with these focal lengths and its best relative pose, in squared sigmas."""
    pose = refined_pose(pair, pose_of(pair, focals), focals)
    points = correspondences_of(pair, float(focals[pair.camera_i]), float(focals[pair.camera_j]))
    sigma = max(pair.noise_px, NOISE_FLOOR_PX)
    return 4.0 * cauchy_cost(sampson_errors_px(points, *pose), 2.0 * sigma)
