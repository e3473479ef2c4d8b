"""Derivatives, tangents, bundle adjustment and significance of relative poses."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesfm.geometry.rotations import angle_between, angle_of, exp_so3
from snakesfm.two_view.bundle import inverse_depths, refine_bundle
from snakesfm.two_view.correspondences import correspond, first_rows_at_place, unify_matches, unique_matches
from snakesfm.two_view.sampson import (
    Correspondences,
    refine_sampson,
    sampson_errors_px,
    sampson_jacobian,
)
from snakesfm.two_view.significance import significance_of
from snakesfm.two_view.tangents import perturb_pose, tangent_basis

Views = Callable[..., Any]


def of_views(views: Any) -> Correspondences:
    return correspond(views.keypoints_i, views.keypoints_j, views.matches, views.camera_i, views.camera_j)


@given(st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_tangent_basis_is_orthonormal(vector: tuple[float, float, float]) -> None:
    t = np.array(vector) / np.linalg.norm(vector)
    frame = np.column_stack([tangent_basis(t), t])
    assert np.allclose(frame.T @ frame, np.eye(3), atol=1e-12)


def test_jacobian_is_the_derivative(two_views: Views) -> None:
    views = two_views(seed=1, focal_j=1500.0)
    points = of_views(views)
    _, jacobian = sampson_jacobian(points, views.rotation, views.translation)
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-6
        forward = sampson_errors_px(points, *perturb_pose(views.rotation, views.translation, step))
        backward = sampson_errors_px(points, *perturb_pose(views.rotation, views.translation, -step))
        numeric = (forward - backward) / 2e-6
        assert np.allclose(numeric[:200], jacobian[:200, k], rtol=1e-4, atol=1e-2)


def test_sampson_error_is_in_pixels(two_views: Views) -> None:
    views = two_views(seed=2, count=2000, outliers=0, noise_px=0.5, focal_j=1500.0)
    errors = sampson_errors_px(of_views(views), views.rotation, views.translation)
    assert 0.47 < np.std(errors) < 0.53


@pytest.mark.parametrize("refine", [refine_sampson, refine_bundle])
def test_refinement_returns_to_the_truth(two_views: Views, refine: Callable[..., Any]) -> None:
    views = two_views(seed=3, outliers=0, noise_px=0.0)
    start = perturb_pose(views.rotation, views.translation, np.full(5, 0.01))
    rotation, translation = refine(of_views(views), *start, 1.0, 30)
    assert angle_of(rotation @ views.rotation.T) < 1e-5
    assert angle_between(translation, views.translation) < 1e-4


def test_both_refinements_agree(two_views: Views) -> None:
    views = two_views(seed=4, outliers=0, noise_px=0.4)
    start = perturb_pose(views.rotation, views.translation, np.full(5, 0.003))
    by_sampson = refine_sampson(of_views(views), *start, 4.0, 30)
    by_bundle = refine_bundle(of_views(views), *start, 4.0, 30)
    assert np.degrees(angle_of(by_sampson[0] @ by_bundle[0].T)) < 2e-3


def test_inverse_depths_are_true_depths_over_the_baseline() -> None:
    rotation, translation = exp_so3(np.array([0.1, 0.0, 0.0])), np.array([1.0, 0.0, 0.0])
    world = np.array([[0.3, -0.2, 4.0], [1.0, 1.0, 9.0], [0.1, 0.2, -5.0]])
    local = world @ rotation.T + translation
    points = Correspondences(world / world[:, 2:], local / local[:, 2:], 1.0, 1.0)
    assert np.allclose(inverse_depths(points, rotation, translation), 1 / world[:, 2])


def test_significance_grows_with_agreement_and_is_nothing_for_chance() -> None:
    rng = np.random.default_rng(0)
    chance = rng.uniform(0, 500, 200)
    assert significance_of(chance, 1000, 800) < 3
    some, many = chance.copy(), chance.copy()
    some[:30] = 0.2
    many[:120] = 0.2
    assert 10 < significance_of(some, 1000, 800) < significance_of(many, 1000, 800)
    assert significance_of(np.zeros(5), 1000, 800) == 0


def test_duplicates_are_unified_and_conflicts_settled() -> None:
    keypoints = np.array([[1, 1], [2, 2], [1, 1], [3, 3]], dtype=np.float32)
    matches = np.array([[0, 1], [2, 1], [1, 3], [3, 3]], dtype=np.int32)
    places = first_rows_at_place(keypoints)
    unified = unify_matches(places, places, matches)
    assert unified.tolist() == [[0, 1], [1, 3], [3, 3]]
    rows = unique_matches(unified, np.array([0.1, 0.5, -0.2]), np.ones(3, dtype=bool))
    assert rows.tolist() == [0, 2]
    # the second gives way to the first, so that it does not take the third one's keypoint
    chained = np.array([[4, 7], [5, 7], [5, 8]])
    for errors, kept in (([0.1, -0.2, 0.3], [0, 2]), ([0.2, 0.1, 0.3], [1]), ([0.2, 0.3, -0.1], [0, 2])):
        assert unique_matches(chained, np.array(errors), np.ones(3, dtype=bool)).tolist() == kept
    assert unify_matches(places, places, np.zeros((0, 2), dtype=np.int32)).shape == (0, 2)
