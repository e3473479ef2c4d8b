"""A first guess of focal lengths: where fundamental matrices become essential ones."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.calibration.epipolar import EpipolarPair

Array = NDArray[Any]
GRID_SIZE = 60
SWEEPS = 8
VOTE_SCALE = 0.02


def essential_defect(F: Array, focal_i: Array, focal_j: Array) -> Array:
    """How far K_j^T F K_i is from an essential matrix, 0 (is one) to 1.

    The difference of the two larger singular values over their sum, for F (3,3) and focal lengths (G,).
    """
    E = np.broadcast_to(F, (*np.shape(focal_i), 3, 3)).copy()
    E[..., :2, :] *= np.asarray(focal_j)[..., None, None]
    E[..., :, :2] *= np.asarray(focal_i)[..., None, None]
    values = np.linalg.svd(E, compute_uv=False)
    defect: Array = (values[..., 0] - values[..., 1]) / (values[..., 0] + values[..., 1])
    return defect


def vote_focals(
    pairs: Sequence[EpipolarPair], focals: Array, free: Array, low: Array, high: Array
) -> Array:
    """Focal lengths (C,) in pixels on which most fundamental matrices agree.

    Parameters
    ----------
    pairs : usable pairs.
    focals : (C,) known or prior focal lengths.
    free : (C,) bool, whose focal length is looked for.
    low, high : (C,) bounds.

    One camera after the other is set to the place on a logarithmic grid where the robust sum of the defects
    of its pairs is smallest, the others held, until nothing changes.
    Source of the criterion: Mendonca and Cipolla, A simple technique for self-calibration, CVPR 1999.
    """
    focals = np.array(focals, dtype=np.float64)
    of_camera: dict[int, list[EpipolarPair]] = {int(c): [] for c in np.nonzero(free)[0]}
    for pair in pairs:
        for camera in {pair.camera_i, pair.camera_j}:
            if camera in of_camera:
                of_camera[camera].append(pair)
    for _ in range(SWEEPS):
        changed = False
        for camera, own in of_camera.items():
            if not own:
                continue
            grid = np.geomspace(low[camera], high[camera], GRID_SIZE)
            cost = np.zeros(GRID_SIZE)
            for pair in own:
                focal_i = grid if pair.camera_i == camera else np.full(GRID_SIZE, focals[pair.camera_i])
                focal_j = grid if pair.camera_j == camera else np.full(GRID_SIZE, focals[pair.camera_j])
                cost += np.log1p((essential_defect(pair.F, focal_i, focal_j) / VOTE_SCALE) ** 2)
            best = float(grid[np.argmin(cost)])
            changed |= abs(np.log(best / focals[camera])) > 1e-9
            focals[camera] = best
        if not changed:
            break
    return focals
