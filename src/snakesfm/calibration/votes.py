"""Initial focal lengths: those that turn fundamental matrices into essential matrices."""

from collections.abc import Sequence

import numpy as np

from snakesfm.arrays import Array
from snakesfm.calibration.epipolar import EpipolarPair, cameras_of, rows_of_cameras

GRID_SIZE = 60
SWEEPS = 8
VOTE_SCALE = 0.02


def essential_defect(F: Array, focal_i: Array, focal_j: Array) -> Array:
    """How far K_j^T F K_i is from an essential matrix, 0 (is one) to 1.

    The difference of the two larger singular values over their sum, for F (...,3,3) of rank 2 and focal
    lengths (...,G).
    """
    F = np.asarray(F) / np.linalg.norm(F, axis=(-2, -1), keepdims=True)
    one = np.ones(np.shape(focal_i))
    rows, columns = (np.stack([np.square(f), np.square(f), one], axis=-1) for f in (focal_j, focal_i))
    squares = np.einsum("...ab,...ga,...gb->...g", F**2, rows, columns)
    # of a matrix of rank 2, the norm of the cofactors is the product of the singular values
    cofactors = np.stack([np.cross(F[..., k - 2, :], F[..., k - 1, :]) for k in range(3)], axis=-2)
    rows, columns = (np.stack([f[..., 1], f[..., 1], f[..., 1] ** 2], axis=-1) for f in (rows, columns))
    twice = 2.0 * np.sqrt(np.einsum("...ab,...ga,...gb->...g", cofactors**2, rows, columns))
    defect: Array = np.sqrt(np.maximum(squares - twice, 0.0) / (squares + twice))
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
    ends = cameras_of(pairs)
    F = np.array([pair.F for pair in pairs]).reshape(-1, 3, 3)
    rows = {camera: rows for camera, rows in enumerate(rows_of_cameras(ends, len(focals))) if free[camera]}
    for _ in range(SWEEPS):
        changed = False
        for camera, own in rows.items():
            if not len(own):
                continue
            grid = np.geomspace(low[camera], high[camera], GRID_SIZE)
            focal_i, focal_j = (
                np.where(side[:, None] == camera, grid, focals[side][:, None]) for side in ends[own].T
            )
            cost = np.log1p((essential_defect(F[own], focal_i, focal_j) / VOTE_SCALE) ** 2).sum(axis=0)
            best = float(grid[np.argmin(cost)])
            changed |= abs(np.log(best / focals[camera])) > 1e-9
            focals[camera] = best
        if not changed:
            break
    return focals
