import time

import numpy as np
import pytest

from snakesfm.geometry.rotations import angle_between, angle_of
from snakesfm.synthetic.problems import make_problem, perturb_rotations

LAYOUTS = ["ring", "street", "area", "facade"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_exact_problem_reprojects_onto_its_keypoints(layout):
    problem = make_problem(20, 800, layout, noise_px=0.0, rotation_noise_deg=0.0)
    track_ids = np.repeat(np.arange(len(problem.points)), np.diff(problem.track_offsets))
    rays = (
        np.einsum("lij,lj->li", problem.rotations[problem.track_image_ids], problem.points[track_ids])
        + problem.translations[problem.track_image_ids]
    )
    pixels = np.asarray(problem.cameras[0].to_pycolmap().img_from_cam(rays))
    assert np.all(rays[:, 2] > 0)
    assert np.abs(pixels - problem.track_keypoints).max() < 1e-3
    i, j = problem.pairs.T
    relative = problem.rotations[j] @ problem.rotations[i].transpose(0, 2, 1)
    translations = problem.translations[j] - np.einsum("eij,ej->ei", relative, problem.translations[i])
    assert angle_of(problem.edge_rotations @ relative.transpose(0, 2, 1)).max() < 1e-9
    assert angle_between(translations, problem.edge_translations).max() < 1e-9


@pytest.mark.parametrize("layout", LAYOUTS)
def test_structure_is_well_formed(layout):
    problem = make_problem(30, 1000, layout, outlier_ratio=0.1, pair_outlier_ratio=0.2, max_views=6)
    lengths = np.diff(problem.track_offsets)
    assert lengths.min() >= 2
    assert lengths.max() <= 6
    assert len(lengths) == len(problem.points)
    same = np.repeat(np.arange(len(lengths)), lengths)
    within = same[1:] == same[:-1]
    assert np.all(np.diff(problem.track_image_ids)[within] > 0)
    counts = np.array([len(k) for k in problem.keypoints])
    assert np.all(problem.track_keypoint_ids < counts[problem.track_image_ids])
    assert np.all(problem.pairs[:, 0] < problem.pairs[:, 1])
    keys = problem.pairs[:, 0] * 30 + problem.pairs[:, 1]
    assert np.all(np.diff(keys) > 0)
    assert np.diff(problem.match_offsets).min() >= 15
    edge = np.repeat(np.arange(len(problem.pairs)), np.diff(problem.match_offsets))
    assert np.all(problem.matches < counts[problem.pairs[edge]])
    left = np.concatenate(problem.keypoint_points)[
        np.concatenate([[0], np.cumsum(counts)])[problem.pairs[edge, 0]] + problem.matches[:, 0]
    ]
    right = np.concatenate(problem.keypoint_points)[
        np.concatenate([[0], np.cumsum(counts)])[problem.pairs[edge, 1]] + problem.matches[:, 1]
    ]
    good = ~problem.match_outliers
    assert np.all(left[good] == right[good])
    assert np.all(left[good] >= 0)


def test_noise_has_the_stated_size():
    exact = make_problem(30, 2000, "area", noise_px=0.0)
    noisy = make_problem(
        30, 2000, "area", noise_px=0.8, outlier_ratio=0.2, rotation_noise_deg=0.5, pair_outlier_ratio=0.25
    )
    assert np.array_equal(exact.centers, noisy.centers)
    assert np.array_equal(exact.points, noisy.points)
    good = ~noisy.track_outliers
    error = (noisy.track_keypoints - exact.track_keypoints)[good]
    assert 0.75 < error.std() < 0.85
    assert 0.17 < noisy.track_outliers.mean() < 0.23
    assert 0.15 < noisy.edge_outliers.mean() < 0.35
    i, j = noisy.pairs.T
    relative = noisy.rotations[j] @ noisy.rotations[i].transpose(0, 2, 1)
    inliers = ~noisy.edge_outliers
    angles = angle_of(noisy.edge_rotations @ relative.transpose(0, 2, 1))
    sigma = np.sqrt(noisy.edge_covariances[:, 0, 0])
    assert 0.8 < np.sqrt(np.mean((angles[inliers] / sigma[inliers]) ** 2) / 3.0) < 1.2
    assert np.median(np.degrees(angles[~inliers])) > 20.0


def test_seed_decides_everything():
    one, same, other = make_problem(seed=3), make_problem(seed=3), make_problem(seed=4)
    assert np.array_equal(one.matches, same.matches)
    assert np.array_equal(one.track_keypoints, same.track_keypoints)
    assert not np.array_equal(one.centers, other.centers)


def test_perturbed_rotations_are_off_by_the_stated_angle():
    problem = make_problem(200, 200, "area")
    noisy = perturb_rotations(problem.rotations, 0.5, seed=1)
    angles = np.degrees(angle_of(noisy @ problem.rotations.transpose(0, 2, 1)))
    assert 0.75 < np.sqrt(np.mean(angles**2)) < 1.0


@pytest.mark.parametrize(("cameras", "points"), [(1, 50), (2, 1), (2, 0)])
def test_tiny_problems(cameras, points):
    problem = make_problem(cameras, points)
    assert problem.image_count == cameras
    assert len(problem.pairs) == len(problem.edge_rotations)
    assert len(problem.keypoints) == cameras


def test_two_hundred_cameras_take_seconds_even_on_a_slow_machine():
    start = time.process_time()
    make_problem(200, 8000, "street")
    assert time.process_time() - start < 10.0
