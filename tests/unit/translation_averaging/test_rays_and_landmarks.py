"""What translation averaging is made of: directions, rays, landmarks, and their refinement."""

from dataclasses import replace

import numpy as np
import pytest
from positioned_cameras import LIMITS, errors, positioning

from snakesfm.geometry.rotations import angle_between
from snakesfm.synthetic.problems import make_problem
from snakesfm.translation_averaging import scale_chain
from snakesfm.translation_averaging.angular import refine_angles
from snakesfm.translation_averaging.averagers import with_rays
from snakesfm.translation_averaging.landmarks import cover_cameras, intersect
from snakesfm.translation_averaging.problem import PositioningProblem, direction_sigmas, edge_directions
from snakesfm.translation_averaging.scale_chain import refine_directions, shared_rays
from snakesfm.translation_averaging.support import held_cameras


def test_directions_point_from_camera_i_to_camera_j():
    truth = make_problem(10, 500, "area", rotation_noise_deg=0.0)
    directions = edge_directions(truth.rotations, truth.pairs, truth.edge_translations)
    baselines = truth.centers[truth.pairs[:, 1]] - truth.centers[truth.pairs[:, 0]]
    assert angle_between(directions, baselines).max() < 1e-7


def test_deviation_of_a_direction_is_that_of_its_tangents():
    covariances = np.stack([np.diag([1e-6, 1e-6, 1e-6, 4e-4, 16e-4]), np.full((5, 5), np.nan)])
    assert direction_sigmas(covariances) == pytest.approx([np.sqrt(1e-3), np.radians(5.0)])


def test_rays_point_at_the_points():
    truth = make_problem(10, 300, "ring", noise_px=0.0)
    problem = positioning(truth)
    offsets = truth.points[problem.ray_tracks] - truth.centers[problem.ray_images]
    assert angle_between(offsets, problem.rays).max() < 1e-5


def test_cover_gives_each_camera_its_rays_with_whole_tracks():
    truth = make_problem(30, 2000, "street")
    problem = positioning(truth)
    mask = cover_cameras(problem.ray_images, problem.ray_tracks, 30, 20)
    available = np.bincount(problem.ray_images, minlength=30)
    assert np.all(np.bincount(problem.ray_images[mask], minlength=30) >= np.minimum(available, 20))
    assert 0 < mask.sum() < len(mask)
    for track in np.unique(problem.ray_tracks[mask])[:20]:
        assert mask[problem.ray_tracks == track].all()


@pytest.mark.parametrize("seed", range(3))
def test_the_cover_of_a_cover_is_that_of_all_rays(seed):
    problem = positioning(make_problem(30, 2000, "street", seed=seed))
    some = with_rays(problem, 40)
    for rays_per_camera in (40, 12, 1):
        whole, again = with_rays(problem, rays_per_camera), with_rays(some, rays_per_camera)
        assert 0 < len(whole.rays) < len(problem.rays)
        for name, values in vars(whole).items():
            np.testing.assert_array_equal(getattr(again, name), values)


def test_intersect_ignores_a_wrong_line_and_flags_parallel_ones():
    rng = np.random.default_rng(0)
    target = np.array([0.3, -0.2, 5.0])
    origins = rng.uniform(-2, 2, (8, 3))
    rays = target - origins
    rays[0] = [1.0, 0.0, 0.2]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.concatenate([origins, [[0, 0, 0], [1, 0, 0]]])
    rays = np.concatenate([rays, [[0, 0, 1.0], [0, 0, 1.0]]])
    groups = np.array([0] * 8 + [1, 1])
    points = intersect(origins, rays, groups, 3, rounds=20)
    assert np.linalg.norm(points[0] - target) < 0.01
    assert np.isnan(points[1]).all()
    assert np.isnan(points[2]).all()


def test_lines_that_meet_ahead_outweigh_more_that_meet_behind():
    ahead, behind = np.array([0.0, 0.0, 4.0]), np.array([0.5, 0.2, -4.0])
    origins = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0.5, 0.5, 0]])
    rays = np.concatenate([ahead - origins[:2], origins[2:] - behind])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    (point,) = intersect(origins, rays, np.zeros(5, dtype=int), 1, rounds=20)
    assert np.linalg.norm(point - ahead) < 0.05


def test_shared_rays_lists_each_common_track_of_each_edge():
    truth = make_problem(8, 200, "area")
    problem = positioning(truth)
    edge, left, right = shared_rays(problem)
    assert np.array_equal(problem.ray_tracks[left], problem.ray_tracks[right])
    assert np.array_equal(problem.ray_images[left], problem.pairs[edge, 0])
    assert np.array_equal(problem.ray_images[right], problem.pairs[edge, 1])
    seen = [set(problem.ray_tracks[problem.ray_images == i].tolist()) for i in range(8)]
    expected = [len(seen[i] & seen[j]) for i, j in truth.pairs.tolist()]
    assert np.bincount(edge, minlength=len(truth.pairs)).tolist() == expected


def test_of_many_shared_rays_each_edge_keeps_some(monkeypatch):
    truth = make_problem(8, 200, "area")
    problem = positioning(truth)
    every, *_ = shared_rays(problem)
    counts = np.bincount(every, minlength=len(truth.pairs))
    monkeypatch.setattr(scale_chain, "MANY_SHARED_RAYS", len(every) // 2)
    monkeypatch.setattr(scale_chain, "ENOUGH_SHARED_RAYS", 5)
    edge, left, right = shared_rays(problem)
    assert np.array_equal(problem.ray_tracks[left], problem.ray_tracks[right])
    assert np.array_equal(problem.ray_images[left], problem.pairs[edge, 0])
    enough = len(every) // 2 // len(truth.pairs)
    kept = np.bincount(edge, minlength=len(truth.pairs))
    assert (kept <= np.minimum(counts, enough)).all()
    assert (kept >= np.minimum(counts, enough / 2)).all()
    assert kept.sum() < len(every)


def test_directions_of_outlier_pairs_are_mended_from_rays():
    truth = make_problem(20, 1500, "area", 0.5, 0.05, 0.3, 0.3, seed=1)
    problem = positioning(truth)
    mended, _ = refine_directions(problem, *shared_rays(problem), np.radians(0.5))
    baselines = truth.centers[truth.pairs[:, 1]] - truth.centers[truth.pairs[:, 0]]
    before = np.degrees(angle_between(problem.directions, baselines))
    after = np.degrees(np.minimum(angle_between(mended, baselines), angle_between(-mended, baselines)))
    inliers = ~truth.edge_outliers
    assert np.median(after[inliers]) < 0.8 * np.median(before[inliers])
    assert (after < 3.0).mean() > (before < 3.0).mean() + 0.1


def test_a_camera_without_telling_landmarks_is_held_by_its_edges():
    truth = make_problem(20, 1500, "area", noise_px=0.3, seed=1)
    problem = positioning(truth)
    points = truth.points.copy()
    assert held_cameras(problem, truth.centers, points, LIMITS).all()
    own = np.unique(problem.ray_tracks[problem.ray_images == 19])
    points[own] = np.nan
    assert held_cameras(problem, truth.centers, points, LIMITS)[19]
    unlinked = problem.select_edges((problem.pairs != 19).all(axis=1))
    assert not held_cameras(unlinked, truth.centers, points, LIMITS)[19]
    # landmarks of two cameras are where their rays meet, wherever the cameras are
    pair = np.isin(problem.ray_images, [18, 19]) | ~np.isin(problem.ray_tracks, own)
    two = unlinked.select_rays(pair)
    assert np.count_nonzero(two.ray_images == 19) > LIMITS.min_support
    assert not held_cameras(two, truth.centers, truth.points, LIMITS)[19]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_whether_a_camera_is_held_does_not_depend_on_the_scale(scale):
    truth = make_problem(12, 600, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=3)
    problem = positioning(truth)
    problem = problem.select_edges((problem.pairs != 4).all(axis=1))
    mine = problem.ray_images == 4
    narrow = np.degrees(angle_between(problem.rays, problem.rays[mine].mean(axis=0))) < 8.0
    limits = replace(LIMITS, max_relative_sigma=0.01)
    for rays, kept in ((np.ones_like(mine), True), (~mine | narrow, False)):
        some = problem.select_rays(rays)
        assert np.count_nonzero(some.ray_images == 4) > limits.min_support
        held = held_cameras(some, scale * truth.centers, scale * truth.points, limits)
        np.testing.assert_array_equal(held, kept | (np.arange(12) != 4))


def test_refinement_improves_a_disturbed_start_and_keeps_missing_cameras():
    truth = make_problem(20, 800, "ring", noise_px=0.5, seed=2)
    problem = positioning(truth)
    start = truth.centers + np.random.default_rng(0).normal(0, 0.2, truth.centers.shape)
    start[4] = np.nan
    refined, points = refine_angles(problem, start, np.radians(0.1))
    assert np.isnan(refined[4]).all()
    keep = np.arange(20) != 4
    assert errors(refined, truth.centers).max() < 0.05
    assert errors(start[keep], truth.centers[keep]).max() > 0.2
    assert points.shape == (problem.ray_tracks.max() + 1, 3)


def test_landmarks_of_very_many_rays_are_cut_and_say_the_same(monkeypatch):
    rng = np.random.default_rng(5)
    cameras, landmarks = 90, 30
    centers = rng.normal(size=(cameras, 3))
    points = rng.normal(size=(landmarks, 3)) * 0.5 + [0.0, 0.0, 6.0]
    images, tracks = np.tile(np.arange(cameras), landmarks), np.repeat(np.arange(landmarks), cameras)
    rays = points[tracks] - centers[images] + rng.normal(0, 1e-3, (len(images), 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pairs = np.array([(i, j) for i in range(cameras) for j in range(i + 1, min(cameras, i + 6))])
    directions = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    problem = PositioningProblem(
        cameras, pairs, directions, np.full(len(pairs), 0.01), images, tracks, rays
    )
    start = centers + rng.normal(0, 0.05, centers.shape)
    cut, spots = refine_angles(problem, start, 1e-3)
    monkeypatch.setattr("snakesfm.translation_averaging.angular.RAYS_PER_LANDMARK", cameras)
    whole, _ = refine_angles(problem, start, 1e-3)
    monkeypatch.setattr("snakesfm.translation_averaging.angular.PAIRS_AT_ONCE", 1000)
    pieces, _ = refine_angles(problem, start, 1e-3)
    np.testing.assert_allclose(pieces, whole, atol=1e-9)
    assert not np.array_equal(cut, whole)
    assert errors(cut, centers).mean() < 1.3 * errors(whole, centers).mean()
    assert errors(cut, centers).mean() < 0.2 * errors(start, centers).mean()
    assert np.isfinite(spots).all()
    assert len(spots) == landmarks
