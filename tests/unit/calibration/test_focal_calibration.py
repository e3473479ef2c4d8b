"""Focal lengths from matched pairs."""

from typing import Any

import numpy as np
import pytest

from snakesfm.calibration.adjustment import adjust_focals
from snakesfm.calibration.epipolar import estimate_epipolar_pair
from snakesfm.calibration.focal import MatchedPair, calibrate_focals, choose_pairs
from snakesfm.calibration.votes import essential_defect, vote_focals
from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import exp_so3

Array = np.ndarray[Any, Any]
OPTIONS = CalibrateCamerasOptions()
CENTER = np.array([500.0, 400.0])


def view_pair(
    seed: int,
    focal_i: float,
    focal_j: float,
    cameras: tuple[int, int] = (0, 0),
    scene: str = "box",
    noise_px: float = 0.3,
    forward: bool = False,
) -> MatchedPair:
    """200 points of a box or a plane that two cameras around it see, 10 % of the matches wrong."""
    rng = np.random.default_rng(seed)
    world = rng.uniform([-2, -1.5, -2], [2, 1.5, 2], (200, 3))
    if scene == "plane":
        world[:, 2] = 0.3 * world[:, 0]
    keypoints = []
    for side, focal in enumerate((focal_i, focal_j)):
        turn = np.array(
            [rng.uniform(-0.2, 0.2), (side - 0.5) * rng.uniform(0.3, 0.6), rng.uniform(-0.2, 0.2)]
        )
        if forward:
            turn = np.zeros(3)
        distance = rng.uniform(6, 10) if not forward else 9.0 - 1.5 * side
        local = world @ exp_so3(turn).T + np.array([*rng.uniform(-0.3, 0.3, 2) * (not forward), distance])
        keypoints.append(focal * local[:, :2] / local[:, 2:] + CENTER + rng.normal(0, noise_px, (200, 2)))
    keypoints[1][:20] = rng.uniform(0, [1000, 800], (20, 2))
    return MatchedPair(*cameras, keypoints[0].astype(np.float32), keypoints[1].astype(np.float32), seed)


def camera(focal: float, source: str = "default") -> Camera:
    return Camera("SIMPLE_RADIAL", 1000, 800, (focal, *CENTER.tolist(), 0.0), source)


def test_defect_vanishes_at_the_true_focal_lengths() -> None:
    pair = view_pair(1, 900, 1300, noise_px=0)
    found = estimate_epipolar_pair(0, 1, pair.points_i - CENTER, pair.points_j - CENTER, 0.5, 0.8, 0)
    assert found is not None
    at_truth = essential_defect(found.F, np.array([900.0]), np.array([1300.0]))[0]
    elsewhere = essential_defect(found.F, np.array([1800.0]), np.array([700.0]))[0]
    assert at_truth < 0.01 < elsewhere


def test_planar_pair_does_not_vote() -> None:
    pair = view_pair(2, 900, 900, scene="plane")
    assert estimate_epipolar_pair(0, 0, pair.points_i - CENTER, pair.points_j - CENTER, 1.0, 0.8, 0) is None


@pytest.mark.parametrize("focal", [700.0, 1000.0, 2200.0])
def test_one_camera_of_all_images(focal: float) -> None:
    pairs = [view_pair(10 + k, focal, focal) for k in range(12)]
    result = calibrate_focals(pairs, [camera(1200.0)], OPTIONS)
    assert result.cameras[0].source == "estimated"
    assert 1e-6 < abs(result.cameras[0].focal_px / focal - 1) < 0.02
    assert 0.03 < result.sigmas[0] < 0.1
    assert result.pair_counts[0] >= 10


def test_threads_do_not_change_the_result() -> None:
    pairs = [view_pair(10 + k, 1000.0, 1000.0) for k in range(6)]
    one, three = (calibrate_focals(pairs, [camera(1200.0)], OPTIONS, threads) for threads in (1, 3))
    assert one.cameras == three.cameras
    np.testing.assert_array_equal(one.sigmas, three.sigmas)


def test_cameras_of_their_own_beside_a_given_one() -> None:
    focals = [900.0, 1400.0, 700.0, 1100.0]
    pairs = [
        view_pair(50 + 10 * i + j, focals[i], focals[j], (i, j)) for i in range(4) for j in range(i + 1, 4)
    ] * 2
    cameras = [camera(900.0, "given"), *(camera(1200.0) for _ in range(3))]
    result = calibrate_focals(pairs, cameras, OPTIONS)
    assert result.cameras[0] == cameras[0]
    assert result.sigmas[0] == 0
    for found, focal in zip(result.cameras[1:], focals[1:], strict=True):
        assert abs(found.focal_px / focal - 1) < 0.05


def test_wrong_pairs_are_outvoted() -> None:
    pairs = [view_pair(100 + k, 900, 900) for k in range(9)] + [view_pair(k, 2500, 2500) for k in range(3)]
    result = calibrate_focals(pairs, [camera(1200.0)], OPTIONS)
    assert abs(result.cameras[0].focal_px / 900 - 1) < 0.03


def test_forward_motion_keeps_the_prior() -> None:
    pairs = [view_pair(200 + k, 900, 900, forward=True) for k in range(6)]
    result = calibrate_focals(pairs, [camera(1200.0)], OPTIONS)
    assert result.cameras[0] == camera(1200.0)
    assert np.isnan(result.sigmas[0])


@pytest.mark.parametrize(("exif", "within"), [(930.0, 0.03), (1500.0, 0.03)])
def test_exif_is_joined_where_right_and_overruled_where_wrong(exif: float, within: float) -> None:
    pairs = [view_pair(300 + k, 900, 900) for k in range(8)]
    result = calibrate_focals(pairs, [camera(exif, "exif")], OPTIONS)
    assert abs(result.cameras[0].focal_px / 900 - 1) < within


def test_without_pairs_priors_stay() -> None:
    cameras = [camera(1200.0), camera(800.0, "exif"), camera(900.0, "given")]
    result = calibrate_focals([], cameras, OPTIONS)
    assert result.cameras == cameras
    assert np.isnan(result.sigmas[0])
    assert result.sigmas[1:].tolist() == [OPTIONS.exif_sigma, 0.0]


def test_empty_adjustment_returns_the_start() -> None:
    one = np.array([800.0])
    result = adjust_focals([], one, np.array([True]), one, np.array([0.5]))
    assert result.focals.tolist() == pytest.approx([800.0])
    assert vote_focals([], one, np.array([True]), one / 2, one * 2).tolist() == [800.0]


def test_chosen_pairs_are_strong_bounded_and_spread() -> None:
    images = 100
    pairs = np.array([(i, i + d) for i in range(images) for d in (1, 2, 3) if i + d < images])
    counts = 1000 - pairs[:, 0] - 100 * (pairs[:, 1] - pairs[:, 0])
    chosen = choose_pairs(pairs, counts, np.zeros(images, dtype=int), np.array([True]), 30, 40)
    assert len(chosen) == 30
    assert np.bincount(pairs[chosen].ravel()).max() <= 2
    assert len(choose_pairs(pairs, counts, np.zeros(images, dtype=int), np.array([False]), 30, 40)) == 0
    assert len(choose_pairs(pairs, counts, np.zeros(images, dtype=int), np.array([True]), 30, 5000)) == 0
    own = choose_pairs(pairs, counts, np.arange(images), np.ones(images, dtype=bool), 2, 40)
    assert 100 <= len(own) <= 200
