from dataclasses import replace

import numpy as np
import pytest

from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.geometry.rotations import angle_between
from snakesfm.stages.average_translations import positioning_settings
from snakesfm.synthetic.problems import make_problem, perturb_rotations
from snakesfm.translation_averaging import scale_chain
from snakesfm.translation_averaging.angular import refine_angles
from snakesfm.translation_averaging.average import (
    DOUBTFUL_SHARE,
    agreeing_share,
    average_translations,
    normalize_gauge,
)
from snakesfm.translation_averaging.averagers import share_at_one_scale, with_rays
from snakesfm.translation_averaging.clusters import join_by_edges
from snakesfm.translation_averaging.landmarks import cover_cameras, edge_angles_rad, intersect
from snakesfm.translation_averaging.problem import (
    PositioningProblem,
    direction_sigmas,
    edge_directions,
    world_rays,
)
from snakesfm.translation_averaging.recovery import mfas_weights
from snakesfm.translation_averaging.scale_chain import chain_centers, refine_directions, shared_rays
from snakesfm.translation_averaging.support import held_cameras


def settings(**options):
    """What the options' defaults with changes say, and no restarts if not told."""
    return positioning_settings(AverageTranslationsOptions(**{"restarts": 0} | options), 0)


def averager(method, **options):
    return settings(method=method, **options).averager


SETTINGS = settings()
LIMITS = SETTINGS.limits
CHAIN = SETTINGS.averager


def positioning(truth, rotations=None):
    rotations = truth.rotations if rotations is None else rotations
    lengths = np.diff(truth.track_offsets)
    images = truth.track_image_ids.astype(np.int64)
    return PositioningProblem(
        truth.image_count,
        truth.pairs.astype(np.int64),
        edge_directions(rotations, truth.pairs, truth.edge_translations),
        np.sqrt(truth.edge_covariances[:, 3, 3]),
        images,
        np.repeat(np.arange(len(lengths)), lengths),
        world_rays(rotations, images, truth.cameras[0].normalize(truth.track_keypoints)),
    )


def thinned(problem):
    """The rays that averagers are given."""
    return with_rays(problem, SETTINGS.rays_per_camera)


def errors(centers, truth):
    known = np.isfinite(centers[:, 0])
    a = centers[known] - np.median(centers[known], axis=0)
    b = truth[known] - np.median(truth[known], axis=0)
    scale = np.sum(a * b) / np.sum(a * a)
    return np.linalg.norm(scale * a - b - np.median(scale * a - b, axis=0), axis=1)


class Misled:
    """First positions that have nothing to do with the scene."""

    def position(self, problem, seed):
        return np.random.default_rng(seed).normal(size=(problem.image_count, 3))


@pytest.mark.parametrize("restarts", [0, 2])
def test_positions_with_which_few_rays_agree_are_looked_for_again(restarts):
    truth = make_problem(20, 1500, "street", noise_px=0.3, rotation_noise_deg=0.05, seed=2)
    problem = positioning(truth)
    misled = replace(settings(refine=False, restarts=restarts), averager=Misled())
    found = average_translations(problem, misled)
    share = agreeing_share(problem, found.centers, LIMITS)
    size = np.ptp(truth.centers, axis=0).max()
    if restarts:
        assert share > 0.9
        assert np.isfinite(found.centers[:, 0]).sum() >= 19
        assert np.median(errors(found.centers, truth.centers)) < 0.02 * size
    else:
        assert share < DOUBTFUL_SHARE
        known = np.isfinite(found.centers[:, 0]).sum()
        assert known < 15 or np.median(errors(found.centers, truth.centers)) > 0.05 * size


def test_positions_with_which_rays_agree_are_final():
    problem = positioning(make_problem(12, 600, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=3))
    once = average_translations(problem, SETTINGS)
    again = average_translations(problem, settings(restarts=3))
    for name, values in vars(once).items():
        np.testing.assert_array_equal(getattr(again, name), values)


def test_rays_of_images_without_a_centre_do_not_agree():
    truth = make_problem(12, 600, "area", noise_px=0.0, rotation_noise_deg=0.0, seed=3)
    problem = positioning(truth)
    assert agreeing_share(problem, truth.centers, LIMITS) > 0.99
    lost = truth.centers.copy()
    lost[:3] = np.nan
    seen = np.mean(~np.isin(problem.ray_images, [0, 1, 2]))
    assert seen - 0.05 < agreeing_share(problem, lost, LIMITS) <= seen + 1e-12
    assert agreeing_share(problem.select_rays(np.zeros(len(problem.rays), bool)), lost, LIMITS) == 1.0


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


@pytest.mark.parametrize("method", ["scale_chain", "global_positioning"])
def test_tracks_are_chosen_once_and_once_more_for_all_restarts(method, monkeypatch):
    problem = positioning(make_problem(12, 600, "area", noise_px=0.3, seed=3))
    told = []

    def cover(images, tracks, count, rays_per_camera):
        told.append((len(images), rays_per_camera))
        return cover_cameras(images, tracks, count, rays_per_camera)

    monkeypatch.setattr("snakesfm.translation_averaging.averagers.cover_cameras", cover)
    monkeypatch.setattr("snakesfm.translation_averaging.average.DOUBTFUL_SHARE", 1.1)
    average_translations(problem, settings(method=method, refine=False, restarts=2, rays_per_camera=20))
    assert told == [(len(problem.rays), 20), (len(problem.rays), 300)]


def test_recovery_has_no_more_rays_than_take_part():
    for rays, recovery, used in ((100, 12, 12), (10, 12, 10), (100, 300, 100)):
        options = AverageTranslationsOptions(rays_per_camera=rays, recovery_rays_per_camera=recovery)
        assert options.resolved().recovery_rays_per_camera == used
        assert options.resolved().rays_per_camera == rays
    usual = AverageTranslationsOptions()
    assert usual.resolved() == usual


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


def join_two_clusters(seed: int, ties: int, wrong: int) -> float | None:
    """Mean error of the second of two clusters, each 8 cameras about 3 wide, by edges some of them wrong."""
    rng = np.random.default_rng(seed)
    centers = np.concatenate([rng.normal(size=(8, 3)) * 3, rng.normal(size=(8, 3)) * 3 + [8, 0, 0]])
    within = [(i, j) for first in (0, 8) for i in range(first, first + 8) for j in range(i + 1, first + 8)]
    between = rng.permutation(64)[:ties]
    pairs = np.concatenate([within, np.column_stack([between // 8, 8 + between % 8])])
    directions = centers[pairs[:, 1]] - centers[pairs[:, 0]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions += rng.normal(size=directions.shape) * np.radians(0.5)
    if wrong:
        directions[-wrong:] = rng.normal(size=(wrong, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    none = np.zeros(0, np.int64)
    problem = PositioningProblem(16, pairs, directions, np.ones(len(pairs)), none, none, np.zeros((0, 3)))
    first, second = centers.copy(), (centers - [3, 1, 2]) * 0.37
    first[8:], second[:8] = np.nan, np.nan
    joined = join_by_edges(problem, [first, second], 0.1)[8:]
    return float(np.linalg.norm(joined - centers[8:], axis=1).mean()) if np.isfinite(joined).all() else None


@pytest.mark.parametrize(
    ("ties", "wrong", "joined", "wrongly"), [(3, 0, 40, 0), (3, 1, 0, 3), (4, 1, 30, 1), (4, 2, 0, 4)]
)
def test_clusters_are_joined_by_more_edges_than_fit_by_chance(ties, wrong, joined, wrongly) -> None:
    errors = [join_two_clusters(seed, ties, wrong) for seed in range(80)]
    found = np.array([error for error in errors if error is not None])
    assert joined <= len(found) <= 80
    assert np.count_nonzero(found > 1.5) <= wrongly


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


def two_clusters(edges_between):
    """Thirty cameras of which the last ten share no landmark with the others, and some edges between them."""
    truth = make_problem(30, 3000, "area", noise_px=0.3, rotation_noise_deg=0.05, seed=3)
    problem = positioning(truth)
    second = np.arange(30) >= 20
    across = second[problem.pairs[:, 0]] != second[problem.pairs[:, 1]]
    kept = ~across
    kept[np.flatnonzero(across)[edges_between]] = True
    tracks = 2 * problem.ray_tracks + second[problem.ray_images]
    order = np.lexsort((problem.ray_images, tracks))
    apart = replace(
        problem,
        ray_images=problem.ray_images[order],
        ray_tracks=tracks[order],
        rays=problem.rays[order],
    )
    return truth, apart.select_edges(kept), second


@pytest.mark.parametrize("averager", ["chain", "whole"])
def test_clusters_without_common_landmarks_are_joined_by_edges(averager):
    truth, problem, second = two_clusters(slice(0, 40, 10))
    if averager == "chain":
        centers = chain_centers(problem, np.radians(0.45), 0.1)
    else:
        centers = average_translations(problem, SETTINGS).centers
    assert np.isfinite(centers).all()
    extent = np.linalg.norm(np.ptp(truth.centers, axis=0))
    assert errors(centers, truth.centers).max() < 0.02 * extent
    # each cluster has its shape from landmarks, so it is what lies between them that may err
    assert errors(centers[second], truth.centers[second]).max() < 0.005 * extent


def test_a_wrong_edge_between_clusters_is_outvoted():
    truth, problem, second = two_clusters(slice(0, 50, 10))
    across = np.flatnonzero(second[problem.pairs[:, 0]] != second[problem.pairs[:, 1]])
    directions = problem.directions.copy()
    directions[across[0]] = np.roll(directions[across[0]], 1)
    centers = chain_centers(replace(problem, directions=directions), np.radians(0.45), 0.1)
    extent = np.linalg.norm(np.ptp(truth.centers, axis=0))
    assert np.isfinite(centers).all() and errors(centers, truth.centers).max() < 0.02 * extent


@pytest.mark.parametrize("edges_between", [slice(0, 0), slice(0, 1)])
def test_a_cluster_stays_out_where_edges_do_not_tell_its_scale(edges_between):
    truth, problem, second = two_clusters(edges_between)
    centers = chain_centers(problem, np.radians(0.45), 0.1)
    assert np.array_equal(np.isfinite(centers[:, 0]), ~second)
    assert errors(centers, truth.centers).max() < 0.005 * np.linalg.norm(np.ptp(truth.centers, axis=0))


@pytest.mark.parametrize(("directions", "count"), [("true", 10), ("random", 0), ("negated", 0)])
def test_a_cluster_stays_out_where_edges_contradict_each_other_or_its_direction(directions, count):
    _, problem, second = two_clusters(slice(None))
    across = second[problem.pairs[:, 0]] != second[problem.pairs[:, 1]]
    others = problem.directions.copy()
    if directions == "random":
        others[across] = np.random.default_rng(1).normal(size=(across.sum(), 3))
        others /= np.linalg.norm(others, axis=1, keepdims=True)
    elif directions == "negated":
        others[across] *= -1.0
    centers = chain_centers(replace(problem, directions=others), np.radians(0.45), 0.1)
    assert np.isfinite(centers[~second]).all()
    assert np.isfinite(centers[second, 0]).sum() == count


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
    refined, points = refine_angles(problem, start, np.radians(0.1), 0.1)
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
    cut, spots = refine_angles(problem, start, 1e-3, 0.1)
    monkeypatch.setattr("snakesfm.translation_averaging.angular.RAYS_PER_LANDMARK", cameras)
    whole, _ = refine_angles(problem, start, 1e-3, 0.1)
    monkeypatch.setattr("snakesfm.translation_averaging.angular.PAIRS_AT_ONCE", 1000)
    pieces, _ = refine_angles(problem, start, 1e-3, 0.1)
    np.testing.assert_allclose(pieces, whole, atol=1e-9)
    assert not np.array_equal(cut, whole)
    assert errors(cut, centers).mean() < 1.3 * errors(whole, centers).mean()
    assert errors(cut, centers).mean() < 0.2 * errors(start, centers).mean()
    assert np.isfinite(spots).all()
    assert len(spots) == landmarks


def test_mfas_weighs_wrong_directions_more():
    truth = make_problem(30, 3000, "area", pair_outlier_ratio=0.15, seed=3)
    weights = mfas_weights(positioning(truth), 60, 0)
    assert weights[truth.edge_outliers].mean() > 3.0 * weights[~truth.edge_outliers].mean()


@pytest.mark.parametrize("layout", ["ring", "street", "area", "facade"])
def test_whole_averaging_with_noise_and_outliers(layout):
    truth = make_problem(40, 2400, layout, 0.7, 0.1, 0.5, 0.1, seed=1)
    problem = positioning(truth, perturb_rotations(truth.rotations, 0.1, 2))
    result = average_translations(problem, SETTINGS)
    found = errors(result.centers, truth.centers)
    assert np.isfinite(result.centers).all()
    assert 1e-4 < np.median(found) < 0.3
    assert found.max() < 1.5
    good = result.edge_residuals_rad[~truth.edge_outliers]
    assert np.degrees(np.median(good)) < 3.0
    assert np.degrees(np.median(result.ray_residuals_rad)) < 0.2


@pytest.mark.parametrize("seed", [1, 2])
def test_scale_chain_withstands_a_third_of_wrong_pairs(seed):
    truth = make_problem(30, 1500, "area", 0.7, 0.1, 0.3, 0.35, seed=seed)
    found = errors(CHAIN.position(thinned(positioning(truth)), 0), truth.centers)
    assert len(found) == 30
    assert 1e-4 < np.median(found) < 0.004 and found.max() < 0.04


def test_weak_camera_is_not_thrown_away():
    truth = make_problem(20, 1200, "area", 0.5, seed=4)
    problem = positioning(truth)
    rng = np.random.default_rng(0)
    mine = np.flatnonzero(problem.ray_images == 7)
    rays = problem.rays.copy()
    wild = rng.normal(size=(len(mine), 3))
    rays[mine] = wild / np.linalg.norm(wild, axis=1, keepdims=True)
    edges = ~(problem.pairs == 7).any(axis=1)
    damaged = replace(problem.select_edges(edges), rays=rays)
    result = average_translations(damaged, SETTINGS)
    assert np.isnan(result.centers[7]).all()
    assert np.isfinite(np.delete(result.centers, 7, axis=0)).all()
    assert errors(result.centers, truth.centers).max() < 0.2


def test_camera_with_a_few_good_rays_is_placed():
    truth = make_problem(20, 1200, "area", 0.3, seed=4)
    problem = positioning(truth)
    mine = np.flatnonzero(problem.ray_images == 7)
    rows = np.ones(len(problem.rays), dtype=bool)
    rows[mine[12:]] = False
    few = problem.select_rays(rows).select_edges(~(problem.pairs == 7).any(axis=1))
    result = average_translations(few, SETTINGS)
    assert np.isfinite(result.centers[7]).all()
    assert errors(result.centers, truth.centers)[7] < 0.2


def test_pairs_alone_position_what_they_determine():
    truth = make_problem(25, 1500, "area", 0.5, 0.0, 0.2, 0.1, seed=6)
    problem = positioning(truth)
    problem = problem.select_rays(np.zeros(len(problem.rays), dtype=bool))
    result = average_translations(problem, SETTINGS)
    assert np.isfinite(result.centers[:, 0]).sum() >= 20
    assert 1e-4 < np.median(errors(result.centers, truth.centers)) < 0.1


def test_two_images_have_a_unit_baseline():
    truth = make_problem(2, 500, "facade", noise_px=0.1, rotation_noise_deg=0.0)
    result = average_translations(positioning(truth), SETTINGS)
    baseline = result.centers[1] - result.centers[0]
    assert abs(np.linalg.norm(baseline) - 1.0) < 1e-12
    assert angle_between(baseline, truth.centers[1] - truth.centers[0]) < 1e-6


def test_three_images():
    truth = make_problem(3, 600, "area", noise_px=0.2, rotation_noise_deg=0.1, seed=8)
    result = average_translations(positioning(truth), SETTINGS)
    assert np.isfinite(result.centers).all()
    assert errors(result.centers, truth.centers).max() < 0.05


def test_nothing_and_the_smaller_of_two_parts_get_no_center():
    truth = make_problem(16, 900, "area", noise_px=0.3, seed=9)
    problem = positioning(truth)
    empty = problem.select_edges(np.zeros(len(problem.pairs), bool)).select_rays(
        np.zeros(len(problem.rays), bool)
    )
    assert np.isnan(average_translations(empty, SETTINGS).centers).all()
    lone = problem.select_edges(~(problem.pairs == 3).any(axis=1)).select_rays(problem.ray_images != 3)
    result = average_translations(lone, SETTINGS)
    assert np.isnan(result.centers[3]).all()
    assert np.isfinite(np.delete(result.centers, 3, axis=0)).all()


def test_gauge_and_frame():
    truth = make_problem(15, 700, "ring", noise_px=0.1)
    problem = positioning(truth)
    result = average_translations(problem, SETTINGS)
    lengths = np.linalg.norm(
        result.centers[problem.pairs[:, 1]] - result.centers[problem.pairs[:, 0]], axis=1
    )
    assert abs(np.median(lengths) - 1.0) < 1e-9
    assert np.abs(np.median(result.centers, axis=0)).max() < 1e-9
    moved = normalize_gauge(problem, 3.0 * result.centers + 5.0)
    assert np.allclose(moved, result.centers)
    assert np.median(edge_angles_rad(problem, result.centers)) < np.radians(2.0)


def test_result_does_not_depend_on_the_order_of_edges():
    truth = make_problem(15, 700, "area", seed=3)
    problem = with_rays(positioning(truth), 50)
    order = np.random.default_rng(0).permutation(len(problem.pairs))
    one = average_translations(problem, SETTINGS).centers
    two = average_translations(problem.select_edges(order), SETTINGS).centers
    assert np.allclose(one, two, atol=1e-6)
    assert np.array_equal(one, average_translations(problem, SETTINGS).centers)


@pytest.mark.parametrize(("method", "tolerance"), [("scale_chain", 0.0), ("global_positioning", 1e-6)])
def test_numbers_of_tracks_cost_nothing_and_change_nothing(method, tolerance):
    problem = positioning(make_problem(12, 500, "area", seed=3))
    # an array of one number per track up to the highest would take terabytes
    high = replace(problem, ray_tracks=problem.ray_tracks * 10**9 + 10**12)
    few, many = (average_translations(one, settings(method=method)) for one in (problem, high))
    np.testing.assert_allclose(many.centers, few.centers, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(many.ray_residuals_rad, few.ray_residuals_rad, rtol=0.0, atol=tolerance)
    assert np.isfinite(few.centers).all() and len(few.ray_residuals_rad) > 500


def test_loss_scale_of_global_positioning_says_which_rays_count():
    truth = make_problem(8, 150, "area", noise_px=0.5, outlier_ratio=0.1, seed=3)
    robust, plain = (
        averager("global_positioning", positioning_loss_scale=scale, positioning_start="chain")
        for scale in (1e-3, 10.0)
    )
    problem = thinned(positioning(truth))
    found = [errors(a.position(problem, 0), truth.centers) for a in (robust, plain)]
    assert 1e-4 < np.median(found[0]) < 0.1 * np.median(found[1])


@pytest.mark.parametrize(
    "options",
    [{"method": "translation_recovery"}, {"method": "global_positioning", "positioning_start": "chain"}],
)
def test_the_chain_of_other_averagers_has_the_options_of_its_own(options, monkeypatch):
    problem = with_rays(positioning(make_problem(10, 600, "area", seed=3)), 20)
    told = []

    def chain(rays, *limits):
        told.append((len(rays.rays), *limits))
        return chain_centers(rays, *limits)

    monkeypatch.setattr("snakesfm.translation_averaging.averagers.chain_centers", chain)
    few = {"recovery_rays_per_camera": 5, "ray_sigma_deg": 0.5, "max_relative_sigma": 0.2}
    for method in ({"method": "scale_chain"}, options):
        averager(**method, **few).position(problem, 0)
    assert told == [(len(problem.rays), 1.5 * np.radians(0.5), 0.2)] * 2


def test_what_the_chain_falls_back_to_has_the_options_of_recovery():
    truth = make_problem(12, 600, "area", 0.5, 0.1, 0.3, 0.2, seed=6)
    pairs_alone = positioning(truth)
    pairs_alone = pairs_alone.select_rays(np.zeros(len(pairs_alone.rays), dtype=bool))
    found = {
        (method, reject): averager(method, reject_outliers=reject).position(pairs_alone, 0)
        for method in ("scale_chain", "translation_recovery")
        for reject in ("none", "residual")
    }
    for reject in ("none", "residual"):
        np.testing.assert_array_equal(found["scale_chain", reject], found["translation_recovery", reject])
    assert not np.array_equal(found["scale_chain", "none"], found["scale_chain", "residual"])


def test_restarts_have_the_loss_of_global_positioning(monkeypatch):
    problem = positioning(make_problem(12, 600, "area", noise_px=0.3, seed=3))
    told = []

    def position(rays, start, loss_scale, seed):
        told.append((len(rays.rays), start, loss_scale, seed))
        return np.zeros((rays.image_count, 3))

    monkeypatch.setattr("snakesfm.translation_averaging.positioning.position_globally", position)
    misled = settings(refine=False, restarts=2, rays_per_camera=20, positioning_loss_scale=0.2)
    average_translations(problem, replace(misled, averager=Misled()))
    many = len(with_rays(problem, 300).rays)
    assert told == [(many, None, 0.2, 0), (many, None, 0.2, 1)]


def test_cameras_at_one_scale_are_those_whose_baselines_agree():
    count = 20
    line = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1).astype(float)
    pairs = np.concatenate([np.stack([np.arange(count - k), np.arange(k, count)], axis=1) for k in (1, 2)])
    assert share_at_one_scale(pairs, 7.0 * line + 3.0, line) == 1.0
    apart = line.copy()
    apart[12:] += 1000.0
    assert share_at_one_scale(pairs, apart, line) == 0.6
    shrunk = line.copy()
    shrunk[12:] = line[12] + (line[12:] - line[12]) / 1000.0
    # the first two of the shrunken ones still are about as far from those before as they were
    assert share_at_one_scale(pairs, shrunk, line) == 0.7
    assert share_at_one_scale(pairs, np.where(np.arange(count)[:, None] < 12, apart, np.nan), line) == 1.0
    assert share_at_one_scale(pairs[:0], line, line) == 1.0


@pytest.mark.parametrize("reject_outliers", ["none", "mfas"])
def test_recovery_in_parts_at_scales_of_their_own_gives_way_to_the_chain(reject_outliers, capsys):
    truth = make_problem(40, 1600, "street", 1.0, 0.3, 1.0, 0.3, seed=5)
    problem = thinned(positioning(truth, perturb_rotations(truth.rotations, 0.2, 3)))
    recovery = averager("translation_recovery", reject_outliers=reject_outliers)
    found = recovery.position(problem, 0)
    np.testing.assert_array_equal(found, CHAIN.position(problem, 0))
    assert "scale_chain positions the cameras instead" in capsys.readouterr().out
    assert np.median(errors(found, truth.centers)) < 0.01 * np.ptp(truth.centers, axis=0).max()


def test_recovery_at_one_scale_is_kept(capsys):
    problem = thinned(positioning(make_problem(20, 800, "area", 0.5, 0.1, 0.3, 0.1, seed=2)))
    found = averager("translation_recovery", reject_outliers="none").position(problem, 0)
    assert np.isfinite(found).all() and not np.array_equal(found, CHAIN.position(problem, 0))
    assert capsys.readouterr().out == ""
