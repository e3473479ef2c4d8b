"""Focal lengths from matched pairs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import diags_array, random_array

from snakesfm.calibration.adjustment import (
    adjust_condensed,
    adjust_focals,
    correspondences_of,
    inverse_diagonal,
    pose_of,
    refined_pose,
)
from snakesfm.calibration.condensed import condense_pairs, fit_essential
from snakesfm.calibration.epipolar import EpipolarPair, estimate_epipolar_pair, rows_of_cameras
from snakesfm.calibration.focal import MatchedPair, calibrate_focals, choose_pairs
from snakesfm.calibration.profiles import scan_focals
from snakesfm.calibration.votes import essential_defect, vote_focals
from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import exp_so3
from snakesfm.two_view.sampson import cauchy_cost, sampson_errors_px

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


# of .3 longer sides, shorter than any that is estimated
@pytest.mark.parametrize("given", [900.0, 300.0])
def test_cameras_of_their_own_beside_a_given_one(given: float) -> None:
    focals = [given, 1400.0, 700.0, 1100.0]
    pairs = [
        view_pair(50 + 10 * i + j, focals[i], focals[j], (i, j)) for i in range(4) for j in range(i + 1, 4)
    ] * 2
    cameras = [camera(given, "given"), *(camera(1200.0) for _ in range(3))]
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


def test_exif_and_the_pairs_count_by_their_certainty() -> None:
    pairs = [view_pair(300 + k, 900, 900) for k in range(8)]
    alone = calibrate_focals(pairs, [camera(930.0)], OPTIONS)
    joined = calibrate_focals(pairs, [camera(930.0, "exif")], OPTIONS)
    weights = np.array([alone.sigmas[0], OPTIONS.exif_sigma]) ** -2.0
    logs = np.log([alone.cameras[0].focal_px, 930.0])
    # the certainties differ enough for the weights to tell
    assert weights[1] / weights[0] > 1.5 and logs[1] - logs[0] > 0.02
    assert np.log(joined.cameras[0].focal_px) == pytest.approx(np.average(logs, weights=weights), abs=1e-9)
    assert joined.sigmas[0] == pytest.approx(weights.sum() ** -0.5)


def test_one_pair_tells_more_than_a_default_but_not_than_exif() -> None:
    pairs = [view_pair(301, 900, 900)]
    guessed = calibrate_focals(pairs, [camera(1200.0)], OPTIONS)
    assert abs(guessed.cameras[0].focal_px / 900 - 1) < 0.1 and guessed.cameras[0].source == "estimated"
    assert 0.03 < guessed.sigmas[0] < OPTIONS.max_sigma and guessed.pair_counts.tolist() == [1]
    exif = calibrate_focals(pairs, [camera(1200.0, "exif")], OPTIONS)
    assert exif.cameras == [camera(1200.0, "exif")]


@pytest.mark.parametrize(
    ("guess", "bounds"), [(700.0, {"max_focal_ratio": 0.8}), (1100.0, {"min_focal_ratio": 1.0})]
)
def test_a_focal_length_out_of_bounds_is_not_believed(guess: float, bounds: dict[str, float]) -> None:
    pairs = [view_pair(300 + k, 900, 900) for k in range(8)]
    result = calibrate_focals(pairs, [camera(guess)], CalibrateCamerasOptions(**bounds))
    assert result.cameras == [camera(guess)]
    assert calibrate_focals(pairs, [camera(guess)], OPTIONS).cameras[0].source == "estimated"


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


def epipolar_pairs(focal: float, count: int, noise_px: float = 0.3) -> list[EpipolarPair]:
    pairs = [view_pair(400 + k, focal, focal, noise_px=noise_px) for k in range(count)]
    found = [
        estimate_epipolar_pair(0, 0, p.points_i - CENTER, p.points_j - CENTER, 1.0, 0.8, p.seed)
        for p in pairs
    ]
    return [pair for pair in found if pair is not None]


def test_strongest_pairs_are_chosen_first() -> None:
    pairs, counts = np.array([[0, 1], [0, 2], [0, 3], [0, 4]]), np.array([50, 500, 100, 60])
    assert choose_pairs(pairs, counts, np.zeros(5, dtype=int), np.array([True]), 1, 40).tolist() == [1]


def test_no_pair_is_trusted_beyond_two_percent() -> None:
    pairs = epipolar_pairs(900.0, 6, noise_px=0.05)
    one = np.array([900.0])
    sigma = adjust_focals(pairs, one, np.array([True]), one, np.array([0.5])).sigmas[0]
    # six pairs of 2 % each
    assert len(pairs) == 6 and 0.008 < sigma < 0.02


@pytest.mark.parametrize("count", [1, 255, 256, 600])
def test_diagonal_of_an_inverse_is_that_of_the_whole(count: int) -> None:
    rng = np.random.default_rng(count)
    links = random_array((count, count), density=0.01, rng=rng)
    matrix = links @ links.T + diags_array(rng.uniform(0.5, 2.0, count))
    np.testing.assert_allclose(
        inverse_diagonal(matrix), np.diag(np.linalg.inv(matrix.toarray())), rtol=1e-9
    )


def test_pixels_without_a_ray_take_no_part() -> None:
    pair = view_pair(1, 900, 1300)
    points_i, points_j = pair.points_i - CENTER, pair.points_j - CENTER
    points_i[3], points_j[7] = np.nan, np.nan
    whole = np.ones(len(points_i), dtype=bool)
    whole[[3, 7]] = False
    found = estimate_epipolar_pair(0, 1, points_i, points_j, 1.0, 0.8, 0)
    expected = estimate_epipolar_pair(0, 1, points_i[whole], points_j[whole], 1.0, 0.8, 0)
    assert found is not None and expected is not None
    np.testing.assert_array_equal(found.F, expected.F)
    assert estimate_epipolar_pair(0, 1, np.full((30, 2), np.nan), points_j[:30], 1.0, 0.8, 0) is None


def test_defect_is_that_of_the_singular_values() -> None:
    pair = view_pair(1, 900, 1300)
    found = estimate_epipolar_pair(0, 1, pair.points_i - CENTER, pair.points_j - CENTER, 1.0, 0.8, 0)
    assert found is not None
    focal_i, focal_j = np.array([300.0, 900.0, 4000.0]), np.array([2000.0, 1300.0, 500.0])
    for defect, i, j in zip(essential_defect(found.F, focal_i, focal_j), focal_i, focal_j, strict=True):
        values = np.linalg.svd(np.diag([j, j, 1.0]) @ found.F @ np.diag([i, i, 1.0]), compute_uv=False)
        assert defect == pytest.approx((values[0] - values[1]) / (values[0] + values[1]), abs=1e-7)


def test_condensed_form_is_the_sum_of_weighted_squared_errors() -> None:
    (pair,) = epipolar_pairs(900.0, 1)
    focals = np.array([1000.0])
    condensed = condense_pairs([replace(pair, points_i=pair.points_i[:100], points_j=pair.points_j[:100])])
    units = np.full((1, 1, 2), 1000.0) / condensed.scales
    fit = fit_essential(condensed, units, rounds=4)
    pose = refined_pose(pair, pose_of(pair, focals), focals)
    points = correspondences_of(pair, 1000.0, 1000.0).take(np.arange(100))
    errors = sampson_errors_px(points, *pose)
    exact = 4.0 * cauchy_cost(errors, 2.0 * condensed.sigmas[0])
    # the pose refined on all points with another loss is not better for these
    assert 0.5 * exact < fit.costs[0, 0] < 1.02 * exact


def test_condensed_pairs_lead_to_nearly_the_adjusted_focal_length() -> None:
    pairs = epipolar_pairs(900.0, 8)
    start, free, sigma = np.array([1000.0]), np.array([True]), np.array([0.5])
    condensed = adjust_condensed(condense_pairs(pairs), start, free, start, sigma)
    adjusted = adjust_focals(pairs, condensed, free, start, sigma).focals
    assert 1e-9 < abs(condensed[0] / adjusted[0] - 1.0) < 0.01
    assert abs(adjusted[0] / 900.0 - 1.0) < 0.02
    scanned = scan_focals(condense_pairs(pairs), np.array([3000.0]), free, start / 3, start * 6)
    assert 0.75 < scanned[0] / 900.0 < 1.33


def test_no_usable_pair_leaves_the_start() -> None:
    start, free = np.array([1000.0, 500.0]), np.array([True, True])
    condensed = condense_pairs([])
    assert adjust_condensed(condensed, start, free, start, 0.5 * np.ones(2)) == pytest.approx(start)
    np.testing.assert_array_equal(scan_focals(condensed, start, free, start / 2, start * 2), start)


def test_rows_of_cameras_name_each_pair_once() -> None:
    cameras = np.array([[0, 1], [2, 2], [0, 2], [1, 0]])
    found = [rows.tolist() for rows in rows_of_cameras(cameras, 4)]
    assert found == [[0, 2, 3], [0, 3], [1, 2], []]
