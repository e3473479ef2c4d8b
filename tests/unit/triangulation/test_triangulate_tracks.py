"""Triangulation of a scene: skipped images, distortion, angles and colours."""

from itertools import combinations

import numpy as np
import pytest

from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem
from snakesfm.triangulation.interface import TriangulationLimits, max_angles
from snakesfm.triangulation.ransac_dlt import hypotheses_of
from snakesfm.triangulation.tracks import mean_colors, triangulate_tracks

LIMITS = TriangulationLimits(4.0, 1.0)


def run(made, **changes):
    arguments = {
        "cameras": made.cameras,
        "camera_ids": made.camera_ids,
        "rotations": made.rotations,
        "translations": made.translations,
        "offsets": made.track_offsets,
        "image_ids": made.track_image_ids,
        "keypoints": made.track_keypoints,
        "limits": LIMITS,
    }
    return triangulate_tracks(**(arguments | changes))


def test_images_without_a_pose_are_skipped():
    made = make_problem(12, 200, noise_px=0.0)
    translations = made.translations.copy()
    translations[3] = np.nan
    points, kept = run(made, translations=translations)
    assert not kept[made.track_image_ids == 3].any()
    assert kept[made.track_image_ids != 3].mean() > 0.8
    assert np.isfinite(points[:, 0]).mean() > 0.8


def test_distorted_cameras_are_undistorted():
    camera = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.15))
    made = make_problem(12, 200, noise_px=0.0, camera=camera)
    points, _ = run(made)
    found = np.isfinite(points[:, 0])
    assert found.mean() > 0.9
    assert np.median(np.linalg.norm(points[found] - made.points[found], axis=1)) < 1e-3


def test_min_length_drops_points_with_fewer_observations():
    made = make_problem(12, 200, noise_px=0.0)
    lengths = np.diff(made.track_offsets)
    points, kept = run(made, min_length=4)
    assert np.isnan(points[lengths < 4]).all()
    assert not kept[np.repeat(lengths < 4, lengths)].any()


def test_widest_angle_of_two_and_three_rays():
    eye = np.repeat(np.eye(3)[None], 3, axis=0)
    rays = np.array([[0.0, 0.0], [np.tan(0.1), 0.0], [np.tan(0.3), 0.0]])
    two = max_angles(eye[:2], rays[:2], np.zeros(2, int), np.ones(2, bool), 1)
    assert two[0] == pytest.approx(0.1)
    three = max_angles(eye, rays, np.zeros(3, int), np.ones(3, bool), 2)
    assert three[0] == pytest.approx(0.3) and three[1] == 0.0


def test_mean_colors():
    colors = np.array([[0, 10, 255], [2, 20, 255], [7, 7, 7]], dtype=np.uint8)
    np.testing.assert_array_equal(mean_colors(colors, np.array([0, 2, 3])), [[1, 15, 255], [7, 7, 7]])
    assert mean_colors(colors[:0], np.array([0])).shape == (0, 3)


@pytest.mark.parametrize("length", [2, 3, 14, 15, 16, 100, 999])
def test_hypotheses_are_all_pairs_or_as_many_of_them_as_wanted(length):
    limits = TriangulationLimits(4.0, 1.0, max_hypotheses=100)
    pairs = hypotheses_of(length, limits)
    everything = list(combinations(range(length), 2))
    found = list(map(tuple, pairs.tolist()))
    assert len(found) == min(100, len(everything))
    assert found == sorted(set(found)) and set(found) <= set(everything)
    if len(everything) > 100:
        # from everywhere, not from the front
        assert pairs.max() > 0.7 * length and 0.5 * length < pairs[:, 1].mean() < 0.85 * length


def test_chosen_hypotheses_follow_the_seed():
    limits = TriangulationLimits(4.0, 1.0)
    pairs = hypotheses_of(30, limits)
    np.testing.assert_array_equal(hypotheses_of(30, limits), pairs)
    assert not np.array_equal(hypotheses_of(30, TriangulationLimits(4.0, 1.0, seed=1)), pairs)
