"""exp_so3 and log_so3 against scipy, at angles of every size."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from snakesfm.geometry.rotations import angle_of, exp_so3, log_so3

DIRECTIONS = Rotation.random(500, random_state=0).as_matrix()[:, 0]


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-5, 0.1, 1.0, 3.0, np.pi - 1e-7, np.pi - 1e-12])
def test_maps_agree_with_scipy(angle: float) -> None:
    vectors = DIRECTIONS * angle
    matrices = exp_so3(vectors)
    np.testing.assert_allclose(matrices, Rotation.from_rotvec(vectors).as_matrix(), rtol=0, atol=4e-15)
    products = matrices @ matrices.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (500, 1, 1)), rtol=0, atol=4e-15)
    np.testing.assert_allclose(log_so3(matrices), vectors, rtol=1e-12, atol=4e-15)
    np.testing.assert_allclose(angle_of(matrices), angle, rtol=1e-12, atol=4e-15)


def test_half_turns_and_turns_beyond() -> None:
    for axis in np.eye(3):
        half = 2.0 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(log_so3(half)), np.pi * axis, atol=1e-15)
    vectors = DIRECTIONS * 5.0
    np.testing.assert_allclose(log_so3(exp_so3(vectors)), DIRECTIONS * (5.0 - 2.0 * np.pi), atol=1e-14)


@pytest.mark.parametrize("shape", [(), (0,), (4,), (2, 3)])
def test_shapes(shape: tuple[int, ...]) -> None:
    vectors = np.full((*shape, 3), 0.2)
    assert exp_so3(vectors).shape == (*shape, 3, 3)
    np.testing.assert_allclose(log_so3(exp_so3(vectors)), vectors, atol=1e-15)
