"""Two-view problems condensed to a quadratic form of the nine elements of the fundamental matrix.

The sum of squared Sampson errors near a fundamental matrix is a quadratic form of the matrix's elements.
With it, steps cost the same however many points there are, and are made for all pairs at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.calibration.epipolar import EpipolarPair, cameras_of
from snakesfm.geometry.rotations import GENERATORS, exp_so3

NOISE_FLOOR_PX = 0.2
# these fits only find where the adjustment to all points starts
MAX_POINTS = 100
ROUNDS = 2
STEPS = 2
MAX_TURN = 0.3
PROJECTION = np.diag([1.0, 1.0, 0.0])
# derivatives of U diag(1,1,0) V^T by turns of U about its three axes and of V about its first two
TURNS = np.concatenate(
    [
        GENERATORS @ PROJECTION,
        -PROJECTION @ GENERATORS[:2],
    ]
)


@dataclass(frozen=True)
class CondensedPairs:
    """Pairs of images, whose points any matrix condenses to a quadratic form.

    Parameters
    ----------
    cameras : (P,2) int, rows of the cameras.
    F : (P,3,3) fundamental matrices of unit norm, for points in units of ``scales``.
    scales : (P,) pixels.
    sigmas : (P,) pixels, noise of the points.
    products : per pair (M,9), point_j point_i^T of at most ``MAX_POINTS`` points.
    """

    cameras: Array
    F: Array
    scales: Array
    sigmas: Array
    products: tuple[Array, ...]

    def take(self, rows: Array) -> "CondensedPairs":
        """Some of the pairs."""
        return CondensedPairs(
            self.cameras[rows],
            self.F[rows],
            self.scales[rows],
            self.sigmas[rows],
            tuple(self.products[row] for row in rows.tolist()),
        )

    def condense(self, matrices: Array) -> tuple[Array, Array]:
        """Quadratic forms (P,T,9,9) near T fundamental matrices (P,T,9) each, and robust costs (P,T) there.

        f^T form f is the sum of the squared Sampson errors in sigmas, with Cauchy weights, of a matrix f of
        the same norm.
        """
        forms, costs = np.zeros((*matrices.shape, 9)), np.zeros(matrices.shape[:2])
        for row, products in enumerate(self.products):
            F = matrices[row].reshape(-1, 3, 3)
            # the last row and column of a product are the points themselves
            lines = np.concatenate(
                [F[:, :2] @ products[:, 6:].T, F[:, :, :2].transpose(0, 2, 1) @ products[:, 2::3].T], 1
            )
            slopes = np.maximum((lines**2).sum(axis=1), 1e-300) / self.scales[row] ** 2
            squares = (matrices[row] @ products.T) ** 2 / slopes / (2.0 * self.sigmas[row]) ** 2
            weights = 1.0 / ((1.0 + squares) * slopes * self.sigmas[row] ** 2)
            outer = (products[:, :, None] * products[:, None, :]).reshape(-1, 81)
            forms[row] = (weights @ outer).reshape(-1, 9, 9)
            costs[row] = 4.0 * np.log1p(squares).sum(axis=1)
        return forms, costs


def condense_pairs(pairs: Sequence[EpipolarPair]) -> CondensedPairs:
    """Pairs in the form that :class:`CondensedPairs` works on."""
    cameras = cameras_of(pairs)
    scales, F, products = np.ones(len(pairs)), np.zeros((len(pairs), 3, 3)), []
    for row, pair in enumerate(pairs):
        some = slice(None, None, -(-len(pair.points_i) // MAX_POINTS))
        scale = float(np.sqrt(np.mean(pair.points_i**2) + np.mean(pair.points_j**2)))
        points_i, points_j = (
            np.pad(points[some] / scale, ((0, 0), (0, 1)), constant_values=1.0)
            for points in (pair.points_i, pair.points_j)
        )
        matrix = pair.F * np.outer([scale, scale, 1.0], [scale, scale, 1.0])
        scales[row], F[row] = scale, matrix / np.linalg.norm(matrix)
        products.append((points_j[:, :, None] * points_i[:, None, :]).reshape(-1, 9))
    sigmas = np.array([max(pair.noise_px, NOISE_FLOOR_PX) for pair in pairs])
    return CondensedPairs(cameras, F, scales, sigmas, tuple(products))


@dataclass(frozen=True)
class EssentialFit:
    """The best essential matrix of each of N problems.

    Parameters
    ----------
    left, right : (N,3,3) rotations; the essential matrix is left diag(1,1,0) right^T.
    forms : (N,9,9) quadratic forms there.
    costs : (P,T) squared sigmas, N = P T.
    """

    left: Array
    right: Array
    forms: Array
    costs: Array


def fit_essential(
    pairs: CondensedPairs, units: Array, start: EssentialFit | None = None, rounds: int = ROUNDS
) -> EssentialFit:
    """The essential matrices with the smallest costs, by reweighted Gauss-Newton from those nearest to F.

    Parameters
    ----------
    units : (P,T,2) the two focal lengths over the pair's scale, T trials each.
    start : begin there instead.
    rounds : how often the points are weighted anew.
    """
    shape = units.shape[:2]
    units = units.reshape(-1, 2)
    if start is None:
        left, right = _nearest_essential(np.repeat(pairs.F, shape[1], axis=0), units)
    else:
        left, right = start.left, start.right
    forms, costs = pairs.condense(_matrices(left, right, units)[0].reshape(*shape, 9))
    for _ in range(rounds):
        tried = _descend(left, right, forms.reshape(-1, 9, 9), units)
        tried_forms, tried_costs = pairs.condense(_matrices(*tried, units)[0].reshape(*shape, 9))
        better = tried_costs < costs
        costs = np.where(better, tried_costs, costs)
        forms = np.where(better[..., None, None], tried_forms, forms)
        left, right = (
            np.where(better.reshape(-1, 1, 1), new, old)
            for new, old in zip(tried, (left, right), strict=True)
        )
    return EssentialFit(left, right, forms.reshape(-1, 9, 9), costs)


def _descend(left: Array, right: Array, forms: Array, units: Array) -> tuple[Array, Array]:
    """The essential matrices with smaller values of the quadratic forms, by damped Gauss-Newton."""
    costs, values, jacobian = _derivatives(left, right, forms, units)
    damping = np.full(len(left), 1e-6)
    for _ in range(STEPS):
        H, g = _normal_equations(jacobian, forms, values)
        H += (damping * np.trace(H, axis1=1, axis2=2))[:, None, None] * np.eye(5)
        step = -np.linalg.solve(H, g[..., None])[..., 0]
        step *= np.minimum(1.0, MAX_TURN / (np.linalg.norm(step, axis=1) + 1e-12))[:, None]
        tried_left = left @ exp_so3(step[:, :3])
        tried_right = right @ exp_so3(np.pad(step[:, 3:], ((0, 0), (0, 1))))
        tried = _derivatives(tried_left, tried_right, forms, units)
        better = tried[0] < costs
        left = np.where(better[:, None, None], tried_left, left)
        right = np.where(better[:, None, None], tried_right, right)
        costs = np.where(better, tried[0], costs)
        values = np.where(better[:, None], tried[1], values)
        jacobian = np.where(better[:, None, None], tried[2], jacobian)
        damping = np.where(better, 0.1 * damping, 100.0 * damping)
    return left, right


def reduced_equations(units: Array, fit: EssentialFit) -> tuple[Array, Array]:
    """Normal equations (N,2,2), (N,2) of the two log focal lengths, the essential matrix eliminated."""
    forms = fit.forms
    _, values, by_pose = _derivatives(fit.left, fit.right, forms, units)
    _, lengths = _matrices(fit.left, fit.right, units)
    matrix = fit.left @ PROJECTION @ fit.right.transpose(0, 2, 1)
    by_focal = -np.stack([matrix, matrix], axis=1)
    # the focal length of the first image divides the first two columns, that of the second the rows
    by_focal[:, 0, :, 2] = 0.0
    by_focal[:, 1, 2, :] = 0.0
    jacobian = np.concatenate([by_pose, _normalised(by_focal, values, lengths, units)], axis=2)
    H, g = _normal_equations(jacobian, forms, values)
    A, B = H[:, :5, :5], H[:, :5, 5:]
    A = A + 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(5)
    solved = np.linalg.solve(A, np.concatenate([B, g[:, :5, None]], axis=2))
    transposed = B.transpose(0, 2, 1)
    return H[:, 5:, 5:] - transposed @ solved[..., :2], g[:, 5:] - (transposed @ solved[..., 2:])[..., 0]


def _nearest_essential(F: Array, units: Array) -> tuple[Array, Array]:
    left, _, right = np.linalg.svd(_scaled(F, units))
    right = right.transpose(0, 2, 1)
    # the third singular value is 0, so its vectors may change their sign
    for turned in (left, right):
        turned[..., 2] *= np.sign(np.linalg.det(turned))[:, None]
    return left, right


def _derivatives(left: Array, right: Array, forms: Array, units: Array) -> tuple[Array, Array, Array]:
    """Costs (N,), the fundamental matrices of unit norm (N,9) and their derivatives by the pose (N,9,5)."""
    values, lengths = _matrices(left, right, units)
    moved = left[:, None] @ TURNS @ right.transpose(0, 2, 1)[:, None]
    jacobian = _normalised(moved, values, lengths, units)
    costs = np.einsum("nk,nk->n", values, (forms @ values[..., None])[..., 0])
    return costs, values, jacobian


def _normal_equations(jacobian: Array, forms: Array, values: Array) -> tuple[Array, Array]:
    weighted = jacobian.transpose(0, 2, 1) @ forms
    return weighted @ jacobian, (weighted @ values[..., None])[..., 0]


def _normalised(derivatives: Array, values: Array, lengths: Array, units: Array) -> Array:
    """Derivatives (N,9,K) of the scaled matrix made unit, from those of the essential matrix (N,K,3,3)."""
    scaled = _scaled(derivatives, 1.0 / units[:, None]).reshape(*derivatives.shape[:2], 9)
    moved = scaled / lengths[:, None, None]
    along = np.einsum("npk,nk->np", moved, values)
    result: Array = (moved - along[..., None] * values[:, None]).transpose(0, 2, 1)
    return result


def _matrices(left: Array, right: Array, units: Array) -> tuple[Array, Array]:
    """Fundamental matrices (N,9) of unit norm, and the norms (N,) that they had."""
    scaled = _scaled(left @ PROJECTION @ right.transpose(0, 2, 1), 1.0 / units).reshape(-1, 9)
    lengths = np.linalg.norm(scaled, axis=1)
    return scaled / lengths[:, None], lengths


def _scaled(matrices: Array, factors: Array) -> Array:
    """Matrices (...,3,3) with their first two columns and rows times the first and second of the factors.

    Focal lengths make a fundamental matrix an essential one, and their inverses the other way round.
    """
    one = np.ones(factors.shape[:-1])
    columns = np.stack([factors[..., 0], factors[..., 0], one], axis=-1)
    rows = np.stack([factors[..., 1], factors[..., 1], one], axis=-1)
    return np.asarray(matrices * rows[..., :, None] * columns[..., None, :])
