"""The back-end's comparison: its problems, errors, limits and page."""

import dataclasses
import time

import numpy as np
import pytest

from benchmarks.backend.apart import run_apart
from benchmarks.backend.measures import position_errors_percent, rotation_errors_deg
from benchmarks.backend.methods import METHODS
from benchmarks.backend.positions import POSITIONS, pose_positioning
from benchmarks.backend.problems import LAYOUTS, lay_out
from benchmarks.backend.report import overview, position_table, render, rotation_table
from snakesfm.geometry.rotations import angle_between, exp_so3

ROW = {
    "problem": "ring", "cameras": "50", "edges": "300", "outliers": "0.3", "coherent": "0", "seed": "0",
    "method": "colmap", "positions": "", "images": "50", "mean_deg": "0.4", "median_deg": "0.3",
    "p90_deg": "0.9", "mean_percent": "", "median_percent": "", "p90_percent": "", "cpu_s": "0.25",
    "peak_mib": "12", "failure": "", "command": "python -m benchmarks.backend --seeds 2",
}  # fmt: skip


def test_position_errors_are_blind_to_a_similarity_and_see_a_moved_camera():
    rng = np.random.default_rng(0)
    rotations = exp_so3(rng.normal(size=(30, 3)))
    centers = rng.normal(size=(30, 3))
    turn = exp_so3(np.array([[0.3, -0.2, 0.9]]))[0]
    moved = centers.copy()
    extent = np.linalg.norm(np.ptp(centers, axis=0))
    moved[3] += [0.0, 0.1 * extent, 0.0]
    moved[5] = np.nan
    found = 0.2 * moved @ turn.T + [4.0, 5.0, 6.0]
    errors = position_errors_percent(rotations @ turn.T, found, rotations, centers)
    assert len(errors) == 29
    assert errors[3] == pytest.approx(10.0, abs=0.1)
    assert np.delete(errors, 3).max() < 0.1


def test_no_position_gives_no_error():
    rotations = np.tile(np.eye(3), (4, 1, 1))
    nothing = np.full((4, 3), np.nan)
    assert len(position_errors_percent(rotations, nothing, rotations, np.zeros((4, 3)))) == 0


@pytest.mark.parametrize("layout", LAYOUTS)
def test_right_edges_and_rays_of_a_layout_agree_with_its_truth(layout):
    problem = lay_out(layout, 20, 0.3, 1)
    assert 0.1 < problem.wrong.mean() < 0.5
    ready = pose_positioning(problem, problem.truth)
    baselines = np.diff(problem.centers[ready.pairs], axis=1)[:, 0]
    # a wrong edge may have nearly the right rotation by chance, so not all directions agree
    assert np.median(angle_between(baselines, ready.directions)) < np.radians(2.0)
    assert 0.8 * (~problem.wrong).sum() <= len(ready.pairs) <= 1.1 * (~problem.wrong).sum()
    assert np.all(np.diff(problem.ray_tracks) >= 0)
    assert len(ready.rays) == len(problem.rays)


def test_images_without_rotation_have_neither_edges_nor_rays():
    problem = lay_out("area", 20, 0.0, 1)
    averaged = problem.truth.copy()
    averaged[4] = np.nan
    ready = pose_positioning(problem, averaged)
    assert 4 not in ready.pairs
    assert 4 not in ready.ray_images
    assert set(range(20)) - {4} == set(ready.ray_images.tolist())


@pytest.mark.parametrize("name", POSITIONS)
def test_every_method_positions_a_layout_without_wrong_edges(name):
    problem = lay_out("area", 16, 0.0, 0)
    centers = POSITIONS[name](pose_positioning(problem, problem.truth), 0)
    errors = position_errors_percent(problem.truth, centers, problem.truth, problem.centers)
    assert len(errors) == 16
    assert 0.0 < np.median(errors) < 0.5


def test_rotation_errors_are_blind_to_the_world():
    problem = lay_out("ring", 12, 0.0, 0)
    world = exp_so3(np.array([[1.0, 0.5, -0.2]]))[0]
    assert rotation_errors_deg(problem.truth @ world, problem.truth).max() < 1e-5


@pytest.mark.parametrize("seed", range(3))
def test_wrong_edges_of_a_street_do_not_turn_its_cameras(seed):
    problem = lay_out("street", 50, 0.3, seed)
    errors = rotation_errors_deg(METHODS["messages + two_stage"](problem), problem.truth)
    assert 0.1 < np.mean(errors) < 3.0


def test_what_runs_apart_returns_fails_or_is_stopped():
    done = run_apart(lambda: np.arange(3), 60.0)
    assert done.failure == ""
    assert done.value.tolist() == [0, 1, 2]
    assert 0.0 <= done.cpu_s < 60.0
    assert run_apart(lambda: np.zeros(3)[5], 60.0).failure.startswith("IndexError")
    assert run_apart(lambda: time.sleep(30) or np.zeros(0), 0.2).failure == "not done in 0 s"
    assert run_apart(lambda: np.ones(1 << 31), 60.0).failure.startswith(
        ("_ArrayMemoryError", "MemoryError")
    )


def test_large_memory_is_measured_above_the_start():
    # more than a process that ran other tests may have freed and kept
    outcome = run_apart(lambda: np.ones(1 << 25)[:1], 60.0)
    assert 240.0 < outcome.peak_mib < 300.0


def test_tables_hold_medians_spreads_ratios_and_failures():
    rows = [
        ROW,
        ROW | {"seed": "1", "mean_deg": "0.8"},
        ROW | {"method": "ours", "mean_deg": "0.3"},
        ROW | {"method": "slow", "failure": "not done in 3 s", "mean_deg": ""},
    ]
    lines = rotation_table(rows)[-3:]
    assert lines[0].startswith("| ring | 50 | 30% | no | colmap | 50 | 0.600 (0.400 to 0.800) | 1.00 |")
    assert "| ours | 50 | 0.300 (0.300 to 0.300) | 0.50 |" in lines[1]
    assert "| slow | not done in 3 s |" in lines[2]


def test_positions_are_told_by_family_and_at_a_glance():
    placed = ROW | {"positions": "chain", "mean_percent": "0.5", "median_percent": "0.25"}
    rows = [
        placed,
        placed | {"problem": "area", "mean_percent": "1.5", "images": "40"},
        placed | {"outliers": "0.0", "failure": "ValueError", "mean_percent": ""},
    ]
    glance = overview(rows)[-1]
    assert glance == "| 50 | colmap | chain | 1 failed | 1.000 (1.500) | 90% (80%) | 0.2 |"
    table = position_table(rows)
    assert table[-3] == (
        "| ring | 50 | 30% | colmap | chain | 50 | 0.400 | 0.500 (0.500 to 0.500) | 0.250 | 0.2 | 12 |"
    )
    assert "ValueError" in table[-1]
    page = render([ROW, *rows])
    assert page.count("- `python -m benchmarks.backend --seeds 2`") == 1
    assert (
        page.index("## Positions at a glance") < page.index("## Rotations") < page.index("## Positions\n")
    )
    assert "## Positions" not in render([ROW])
    origins = ({"made": "one day, one machine"}, {"made": "another day"}, {})
    page = render([ROW | origin for origin in origins])
    head = page[: page.index("Seconds are of")]
    assert head.count(". Made by\n\n- `python -m benchmarks.backend --seeds 2`\n\n") == 3
    assert "\n\none day, one machine. Made by\n" in head and "\n\nanother day. Made by\n" in head


def test_a_problem_is_saved_with_all_its_arrays(tmp_path):
    problem = lay_out("facade", 8, 0.2, 0)
    problem.save(tmp_path / "p.npz")
    again = type(problem).load(tmp_path / "p.npz")
    for field in dataclasses.fields(problem):
        assert np.array_equal(getattr(again, field.name), getattr(problem, field.name))
