"""Reasons, counts and plots of the report."""

import base64
import dataclasses
import re

import cv2
import numpy as np
import pytest

from snakesfm.geometry.camera import Camera, observation_errors
from snakesfm.geometry.poses import translation_of
from snakesfm.geometry.rotations import exp_so3
from snakesfm.reporting.page import Page, render_page
from snakesfm.reporting.plots import error_histogram, map_box, scene_map, view_axes
from snakesfm.reporting.registration import (
    ImageCounts,
    mean_by_image,
    reason_not_registered,
)
from snakesfm.reporting.tables import (
    ROUND_HEADS,
    bundle_rows,
    image_table,
    label_counts,
    metric_tables,
)
from snakesfm.synthetic.layouts import look_at
from snakesfm.synthetic.problems import make_problem


def counts(**changes: object) -> ImageCounts:
    """Counts of three images; image 0 passed every step but was not registered."""
    values: dict[str, object] = {
        "pairs": [5, 5, 5],
        "accepted": [4, 4, 4],
        "kept": [3, 3, 3],
        "components": [0, 0, 0],
        "rotated": [True] * 3,
        "positioned": [True] * 3,
        "track_observations": [9, 9, 9],
        "point_observations": [8, 8, 8],
        "models": [-1, 0, 0],
        "observations": [0, 7, 2],
        "mean_error_px": [np.nan, 0.5, 0.6],
    } | changes
    return ImageCounts(**{name: np.asarray(value) for name, value in values.items()})


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"pairs": [0, 5, 5]}, "No pair with this image"),
        (
            {"accepted": [0, 4, 4]},
            "None of its 5 pairs was accepted: low inlier ratio (2), too few inliers (3).",
        ),
        ({"kept": [0, 3, 3]}, "All its 4 view-graph edges were refused: cycle min (4)."),
        (
            {"models": [1, 0, 1], "accepted": [0, 4, 4], "kept": [0, 3, 3]},
            "a separate model of 2 images, in sparse/1",
        ),
        ({"components": [2, 0, 0], "positioned": [False, True, True]}, "component of 1 images"),
        ({"components": [2, 0, 0]}, "Bundle adjustment dropped it"),
        ({"rotated": [False, True, True]}, "no rotation"),
        ({"track_observations": [0, 9, 9]}, "in no track"),
        ({"positioned": [False, True, True]}, "found no position"),
        ({"point_observations": [0, 8, 8]}, "triangulated"),
        ({}, "Bundle adjustment dropped it"),
        ({"models": [1, 0, 0], "components": [1, 0, 0]}, "separate model of 1 images, in sparse/1"),
        ({"models": [0, 0, 0]}, ""),
    ],
)
def test_the_reason_names_the_first_step_that_lost_the_image(changes, expected) -> None:
    reasons = {"too_few_inliers": 3, "low_inlier_ratio": 2}
    found = reason_not_registered(0, counts(**changes), "", reasons, {"cycle_min": 4, "component": 0})
    assert expected in found
    assert bool(found) == bool(expected)


def test_a_duplicate_names_the_image_that_stands_for_it() -> None:
    assert "a.jpg" in reason_not_registered(0, counts(), "a.jpg", {}, {})


def test_observation_errors_are_those_of_the_noise() -> None:
    problem = make_problem(camera_count=8, point_count=400, noise_px=0.5)
    points = np.repeat(problem.points, np.diff(problem.track_offsets), axis=0)
    errors = observation_errors(
        problem.cameras,
        problem.camera_ids,
        problem.rotations,
        problem.translations,
        points,
        problem.track_image_ids,
        problem.track_keypoints,
    )
    # the length of a 2D Gaussian of 0.5 px has mean 0.5 sqrt(pi / 2)
    assert 0.6 < errors.mean() < 0.65
    means = mean_by_image(errors, problem.track_image_ids, 9)
    assert np.isnan(means[8])
    assert np.all((means[:8] > 0.4) & (means[:8] < 0.9))


def test_points_behind_a_camera_have_no_error() -> None:
    camera = Camera("PINHOLE", 10, 10, (10.0, 10.0, 5.0, 5.0))
    errors = observation_errors(
        [camera],
        np.zeros(1, int),
        np.eye(3)[None],
        np.zeros((1, 3)),
        np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]),
        np.zeros(2, int),
        np.array([[5.0, 5.0], [5.0, 6.0]]),
    )
    assert errors[0] == np.inf
    assert errors[1] == pytest.approx(1.0)


def test_labels_beyond_the_known_ones_are_still_counted() -> None:
    assert label_counts(np.array([0, 0, 9]), ("kept", "cycle")) == [("kept", 2), ("label 9", 1)]


def test_image_rows_show_errors_against_the_reference_and_the_fewest_observations() -> None:
    names = ["a", "b", "c"]
    scores = {"c": {"rotation_error_deg": 0.1, "position_error": None}}
    heads, rows, note = image_table(names, counts(), scores, 2)
    assert [len(row) for row in rows] == [len(heads)] * 2
    assert [row[0] for row in rows] == ["a", "c"]
    assert rows[0][-3:] == [None, None, None]
    assert rows[1][-2:] == [0.1, None]
    assert "of 3" in note
    heads, rows, note = image_table(names, counts(), {}, 3)
    assert [len(row) for row in rows] == [len(heads)] * 3 and note == ""


def test_metrics_are_grouped_by_threshold_and_statistic_without_texts() -> None:
    metrics = {
        "scene": "x",
        "points": 3,
        "none": None,
        "per_image": {},
        "pose_auc_10deg": 90.0,
        "pose_auc_2.5deg": 80.0,
        "relative_pose_auc_3deg": 70.0,
        "position_error_p90": 0.5,
        "position_error_median": 0.25,
    }
    areas, errors, others = metric_tables(metrics)
    assert areas[1] == ["poses", "@2.5 deg", "@3 deg", "@10 deg"]
    assert areas[2] == [["pose AUC", 80.0, None, 90.0], ["relative pose AUC", None, 70.0, None]]
    assert errors[2] == [["position error", 0.25, None, 0.5, None]]
    assert others[2] == [["points", 3]]


def test_rounds_have_what_their_heads_name() -> None:
    rows = bundle_rows(
        np.array(["10 px"]), np.array([[9, 300, 900]]), np.array([[4.0, 3.5]]), np.array([0.6])
    )
    (row,) = (dict(zip(ROUND_HEADS, row, strict=True)) for row in rows)
    assert row == {
        "round": "10 px",
        "images": 9,
        "points": 300,
        "observations": 900,
        "cost before": 4.0,
        "cost after": 3.5,
        "mean error, detector px": 0.6,
    }


def test_refused_files_are_shown_where_every_image_has_a_pose() -> None:
    page = Page("scene", "lead", "snakesfm", [["total", 1234.6, 12.342, 5000]], list("abcd"), [], [])
    text = render_page(page)
    assert "could not be used" not in text and "every image has a pose" in text
    numbers = re.findall(r'<td class="n">([^<]*)</td>', text)
    assert numbers == ["1,235", "12.34", "5,000"]
    text = render_page(dataclasses.replace(page, refused=[["a.jpg", "no image"]]))
    assert "Files that could not be used" in text and "a.jpg" in text


def test_histogram_has_all_errors_and_bears_none() -> None:
    errors = np.abs(np.random.default_rng(0).normal(size=1000))
    bars = re.findall(r"px: (\d+)</title>", error_histogram(errors))
    assert sum(map(int, bars)) == 1000
    assert error_histogram(np.full(3, np.nan)) == ""
    assert "<svg" in error_histogram(np.zeros(4))


def test_histogram_ends_where_hardly_an_error_is_larger() -> None:
    errors = np.concatenate([np.linspace(0.0, 8.0, 1000), [500.0] * 5])
    svg = error_histogram(errors, bins=4)
    ticks = [float(text) for text in re.findall(r">([^<>]*) px</text>", svg)]
    assert ticks == pytest.approx([0, 2, 4, 6, 8], rel=0.05)
    # the far ones are in the last bar
    assert [int(count) for count in re.findall(r"px: (\d+)</title>", svg)] == pytest.approx(
        [250, 250, 250, 255], abs=5
    )


def test_up_is_that_of_the_cameras_in_any_world() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    centers = np.column_stack([5 * np.cos(angles), 5 * np.sin(angles), np.ones(12)])
    rotations = look_at(centers, np.zeros((12, 3)), np.array([0.0, 0.0, 1.0]))
    turn = exp_so3(np.array([0.5, -1.0, 2.0]))
    turned, moved = rotations @ turn.T, centers @ turn.T
    axes = view_axes(turned, translation_of(turned, moved), np.ones(12, int))
    assert axes[2] == pytest.approx(turn @ [0.0, 0.0, 1.0], abs=1e-6)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_up_of_cameras_that_look_down_from_all_sides_is_against_their_view() -> None:
    rng = np.random.default_rng(0)
    turns = [exp_so3(np.array([0, 0, angle])) for angle in np.linspace(0, 2 * np.pi, 9)[:-1]]
    centers = np.column_stack([rng.uniform(-9, 9, (8, 2)), 20 + rng.normal(0, 0.01, 8)])
    # the same centres, from which they look down or up
    for look, up in ((np.diag([1.0, -1, -1]), 1.0), (np.eye(3), -1.0)):
        rotations = np.array([turn @ look for turn in turns])
        axes = view_axes(rotations, translation_of(rotations, centers), np.ones(8, int))
        assert axes[2] == pytest.approx([0.0, 0.0, up], abs=0.01)


def test_up_of_photographs_that_exif_turns_is_that_of_what_they_show() -> None:
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    centers = np.column_stack([5 * np.cos(angles), 5 * np.sin(angles), np.zeros(12)])
    upright = look_at(centers, np.zeros((12, 3)), np.array([0.0, 0.0, 1.0]))
    # a phone that is held upright stores its pixels lying on their side
    stored = np.stack([upright[:, 1], -upright[:, 0], upright[:, 2]], axis=1)
    axes = view_axes(stored, translation_of(stored, centers), np.full(12, 6))
    assert axes[2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)


def test_the_map_is_seen_from_above_with_the_first_axis_to_the_right() -> None:
    # towards x and y of the world, their images upright
    rotations = np.array([[[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]])
    centers = np.array([[0.0, 0, 0], [10, 20, 0]])
    points = np.array([[5.0, 10, 3], [5, 10, 1], [5, 10, 2]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    svg, outside = scene_map(
        ["low", "high"], rotations, translation_of(rotations, centers), points, colors, np.eye(3)
    )
    assert outside == 0
    marks = re.findall(r"translate\(([\d.]+) ([\d.]+)\) rotate\((-?\d+)\)", svg)
    (low_x, low_y, east), (high_x, high_y, north) = (map(float, mark) for mark in marks)
    assert (east, north) == (0, -90)
    assert high_x - low_x == pytest.approx((low_y - high_y) / 2, rel=0.02) and high_x > low_x
    # the highest of the points hides the others
    data = re.search(r"base64,([^\"]+)", svg)
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert {tuple(pixel) for pixel in picture[picture[..., 3] > 0].tolist()} == {(0, 0, 255, 255)}
    rows, columns = np.nonzero(picture[..., 3])
    assert columns.mean() / 2 == pytest.approx((low_x + high_x) / 2, abs=1)
    assert rows.mean() / 2 == pytest.approx((low_y + high_y) / 2, abs=1)


@pytest.mark.parametrize("count", [1, 2, 9])
def test_the_map_shows_cameras_and_points(count) -> None:
    problem = make_problem(camera_count=9, point_count=300)
    rotations, translations = problem.rotations[:count], problem.translations[:count]
    names = [f"<{k}>" for k in range(count)]
    colors = np.full(problem.points.shape, (250, 10, 20), np.uint8)
    axes = view_axes(rotations, translations, np.ones(count, int))
    svg, outside = scene_map(names, rotations, translations, problem.points, colors, axes)
    assert (svg.count("<path"), outside) == (count, 0)
    assert "&lt;0&gt;" in svg
    data = re.search(r"base64,([^\"]+)", svg)
    assert data is not None
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    shown = picture[picture[..., 3] > 0]
    assert len(shown) > 300
    assert shown[0].tolist() == [20, 10, 250, 255]


def test_the_map_of_a_model_without_points_has_its_cameras() -> None:
    problem = make_problem(camera_count=5, point_count=100)
    axes = view_axes(problem.rotations, problem.translations, np.ones(5, int))
    nothing = np.zeros((0, 3))
    svg, outside = scene_map(
        list("abcde"), problem.rotations, problem.translations, nothing, nothing.astype(np.uint8), axes
    )
    assert (svg.count("<path"), outside) == (5, 0)


@pytest.mark.parametrize(("distance", "count"), [(2.5, 0), (30.0, 2)])
def test_cameras_far_from_all_others_are_outside_the_map(distance: float, count: int) -> None:
    rng = np.random.default_rng(0)
    centers = rng.uniform(-1, 1, (60, 3))
    centers[:2, 0] = distance, -distance
    rotations = np.tile(np.eye(3), (60, 1, 1))
    names = [f"{k}.jpg" for k in range(60)]
    points, colors = rng.uniform(-1, 1, (500, 3)), np.zeros((500, 3), np.uint8)
    svg, outside = scene_map(
        names, rotations, translation_of(rotations, centers), points, colors, np.eye(3)
    )
    assert outside == count
    places = re.findall(r"translate\((-?[\d.]+) (-?[\d.]+)\)", svg)
    width = float(re.search(r'viewBox="0 0 (\d+)', svg)[1])
    shown = [0 <= float(x) <= width for x, _ in places]
    assert shown.count(False) == count
    # however far the far ones are, the others take up over a quarter of the map
    spread = np.ptp([float(x) for x, _ in places[2:]]) / width
    assert 0.25 < spread < 0.4


@pytest.mark.parametrize("count", [10, 20, 60])
@pytest.mark.parametrize("distance", [30.0, 1000.0])
def test_one_camera_far_from_few_others_is_outside_the_map(count: int, distance: float) -> None:
    centers = np.random.default_rng(1).uniform(-1, 1, (count, 2))
    centers[3, 1] = distance
    low, high = map_box(centers, np.zeros((0, 2)))
    assert (low <= centers[np.arange(count) != 3].min(axis=0)).all()
    assert high[1] < 5.0
    # points are shown wherever they are
    low, high = map_box(centers, np.random.default_rng(2).uniform(-50, 50, (500, 2)))
    assert (low < -45).all() and (high > 45).all()


ORDINARY = {
    "square": lambda share, rng: rng.uniform(-1, 1, (len(share), 2)),
    "line": lambda share, rng: np.column_stack([share, 0 * share]),
    "ring": lambda share, rng: np.column_stack([np.cos(2 * np.pi * share), np.sin(2 * np.pi * share)]),
    "aerial grid": lambda share, rng: np.column_stack([(5 * share) % 1, 0.2 * np.floor(5 * share)]),
    "street": lambda share, rng: np.column_stack([9 * np.sqrt(share), rng.normal(0, 0.1, len(share))]),
    "details and a street": lambda share, rng: np.column_stack([9 * np.maximum(0, share - 0.6), 0 * share]),
}


@pytest.mark.parametrize("count", [10, 20, 60])
@pytest.mark.parametrize("layout", ORDINARY)
def test_no_camera_of_an_ordinary_set_is_outside_the_map(count: int, layout: str) -> None:
    for seed in range(20):
        share = (np.arange(count) + 0.5) / count
        centers = ORDINARY[layout](share, np.random.default_rng(seed))
        low, high = map_box(centers, np.zeros((0, 2)))
        assert low == pytest.approx(centers.min(axis=0))
        assert high == pytest.approx(centers.max(axis=0))


@pytest.mark.parametrize("count", [1, 3, 5])
def test_of_a_few_cameras_the_map_shows_all(count: int) -> None:
    centers = np.column_stack([10.0 ** np.arange(count), np.zeros(count)])
    low, high = map_box(centers, np.zeros((0, 2)))
    assert (low[0], high[0]) == (1.0, 10.0 ** (count - 1))


@pytest.mark.parametrize(("beyond", "count"), [(0.04, 0), (0.2, 1)])
def test_a_camera_in_the_margin_is_on_the_map(beyond: float, count: int) -> None:
    centers = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    centers[3, 0] = 1000.0
    low, high = map_box(centers[:, :2], np.zeros((0, 2)))
    centers[3, 0] = high[0] + beyond * (high - low).max()
    rotations, nothing = np.tile(np.eye(3), (20, 1, 1)), np.zeros((0, 3))
    _, outside = scene_map(
        [f"{k}.jpg" for k in range(20)],
        rotations,
        translation_of(rotations, centers),
        nothing,
        nothing.astype(np.uint8),
        np.eye(3),
    )
    assert outside == count
