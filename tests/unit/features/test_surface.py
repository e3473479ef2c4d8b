"""A surface through points, and what it hides."""

import sys

import numpy as np
import pytest

from snakesfm.errors import ConfigError
from snakesfm.features.surface import Surface


def sphere(count=2000):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_sphere_hides_its_far_side(open3d):
    surface = Surface(sphere(), 3000, seed=1)
    assert surface.points.shape == (3000, 3)
    radii = np.linalg.norm(surface.points, axis=1)
    assert radii.min() > 0.97 and radii.max() <= 1
    seen = surface.seen_from(np.array([0.0, 0.0, 4.0]))
    # from a distance of four radii a cap of (1 - 1/4)/2 of the sphere is seen, above z = 1/4
    assert abs(seen.mean() - 0.375) < 0.03
    assert (
        surface.points[seen][:, 2].min() > 0.25 - 0.12 and surface.points[~seen][:, 2].max() < 0.25 + 0.12
    )


def test_points_are_spread_evenly(open3d):
    points = Surface(sphere(), 4000, seed=1).points
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.05)
    octants = np.unique((points > 0) @ [1, 2, 4], return_counts=True)[1]
    assert len(octants) == 8 and octants.min() > 400 and octants.max() < 600


def test_equal_seeds_give_equal_points(open3d):
    first, again, other = (Surface(sphere(300), 100, seed=seed).points for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_without_open3d_there_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(
        ConfigError, match=r"needs open3d, which cannot be loaded .* or set surface_points to 0\.$"
    ):
        Surface(sphere(20), 10, seed=1)
