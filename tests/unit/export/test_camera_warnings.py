"""What users are told of the cameras of an exported model."""

import dataclasses
import json
from types import SimpleNamespace

import finished_model
import numpy as np
import pytest
from finished_model import CAMERA, COUNT, NAMES, export
from PIL import Image

from snakesfm.export import cameras
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem


@pytest.mark.parametrize(
    ("distortion", "intrinsics", "remedy"),
    [
        (0.02, "fixed", None),
        (0.3, "fixed", "the given intrinsics do not describe the lens; intrinsics=refine"),
        (0.3, "refine", "this model does not describe the lens; try another index_images.camera_model"),
    ],
)
def test_a_lens_of_another_distortion_is_warned_of(
    tmp_path, distortion: float, intrinsics: str, remedy: str | None
) -> None:
    lens = dataclasses.replace(CAMERA, params=(*CAMERA.params[:3], distortion))
    seen = make_problem(camera_count=COUNT, point_count=3000, noise_px=0.1, camera=lens)
    folder = export(tmp_path, seen, lost=(), intrinsics=intrinsics)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    # the second camera has but four images
    found = [line for line in summary["warnings"] if "describe the lens" in line]
    assert len(found) == (remedy is not None)
    assert all(line.startswith("camera 1 (SIMPLE_RADIAL)") and str(remedy) in line for line in found)


@pytest.mark.parametrize(("reset", "told"), [("", 0), ("distortion", 1)])
def test_a_camera_that_was_reset_and_held_is_warned_of(tmp_path, problem, reset: str, told: int) -> None:
    folder = export(tmp_path, problem, reset=reset)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "reset and kept fixed" in line]
    assert len(found) == told
    assert all(line.startswith("camera 2 (SIMPLE_RADIAL): its distortion was") for line in found)


@pytest.mark.parametrize(("spread", "told"), [(np.nan, 0), (0.083, 1)])
def test_images_of_several_focal_lengths_are_warned_of(tmp_path, problem, spread: float, told: int) -> None:
    summary = json.loads((export(tmp_path, problem, spread=spread) / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "differ in focal length by 8%" in line]
    assert len(found) == told
    assert all("camera 2 (" in line and "{camera_sharing: per_folder}" in line for line in found)


@pytest.mark.parametrize(("offset", "told"), [(np.nan, 0), (0.0614, 1)])
def test_a_far_principal_point_that_was_left_is_warned_of(
    tmp_path, problem, offset: float, told: int
) -> None:
    folder = export(tmp_path, problem, offset=offset)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "max_principal_point_offset" in line]
    assert len(found) == told
    assert all(line.startswith("camera 2 (SIMPLE_RADIAL): its principal point") for line in found)
    assert all("lie 6.1% of the longer side away" in line for line in found)


def test_a_camera_that_got_a_second_focal_length_is_warned_of() -> None:
    stretched = Camera("OPENCV", 640, 480, (600.0, 450.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    former = ["SIMPLE_RADIAL", "SIMPLE_RADIAL", "OPENCV"]
    found = cameras.stretched_warnings({0: CAMERA, 1: stretched, 2: stretched}, former)
    # what was given or chosen is known
    assert [line.split(" (fx")[0] for line in found] == ["camera 2 (OPENCV): its pixels are not square"]
    assert "fx / fy = 1.33" in found[0]


@pytest.mark.parametrize(
    ("lens", "told"),
    [(CAMERA, 0), (dataclasses.replace(CAMERA, model="FOV", params=(250.0, 250.0, 320.0, 240.0, 1.4)), 2)],
    ids=["usual", "beyond 180 degrees"],
)
def test_pictures_of_which_little_is_left_without_distortion_are_warned_of(
    tmp_path, monkeypatch, lens: Camera, told: int
) -> None:
    monkeypatch.setattr(finished_model, "CAMERA", lens)
    usual = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    seen = make_problem(camera_count=COUNT, point_count=300, noise_px=0.3, camera=usual)
    photos = tmp_path / "photos"
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (640, 480), "red").save(photos / name)
    for undistort, count in ((False, 0), (True, told)):
        summary = json.loads(
            (export(tmp_path, seen, undistort=undistort) / "summary.json").read_text("utf-8")
        )
        found = [line for line in summary["warnings"] if "undistorted/ shows only" in line]
        assert len(found) == count
        assert all(line.startswith(f"camera {row} (FOV)") for row, line in enumerate(found, start=1))


@pytest.mark.parametrize(("count", "named"), [(6, 6), (60, 5)])
def test_a_problem_of_many_cameras_is_told_of_some(monkeypatch, count: int, named: int) -> None:
    folding = Camera("SIMPLE_RADIAL", 640, 480, (300.0, 320.0, 240.0, -1.2))
    wide = Camera("FOV", 640, 480, (250.0, 250.0, 320.0, 240.0, 1.4))
    adjusted = (["distortion"] * count, np.full(count, 0.07), np.full(count, 0.1))
    zero, pose = np.zeros(1, int), (np.eye(3)[None], np.zeros((1, 3)))
    one = (zero, *pose, np.ones((1, 3)), np.array([0, 1]), zero, np.zeros((1, 2)))
    misfits = dict.fromkeys(range(count), SimpleNamespace(misfit=np.inf))
    monkeypatch.setattr(cameras, "fit_lenses", lambda *_: misfits)
    flat = SimpleNamespace(shown=0.1, cropped=0.2)
    told = {
        (
            "not invertible",
            "reset and kept fixed",
            "max_principal_point_offset",
            "differ in focal length",
        ): cameras.adjusted_warnings(dict.fromkeys(range(count), folding), *adjusted),
        ("does not describe the lens",): cameras.lens_warnings([folding] * count, *one, ()),
        ("undistorted/ shows only", "20% of the pixels were cut off"): cameras.flat_warnings(
            dict.fromkeys(range(count), wide), dict.fromkeys(range(count), flat)
        ),
    }
    for kinds, warnings in told.items():
        for kind in kinds:
            found = [line for line in warnings if kind in line]
            assert [line.split()[1] for line in found] == [str(k + 1) for k in range(named)]
        more = [line for line in warnings if "more cameras have the problem" in line]
        assert more == ["55 more cameras have the problem of the warning before this one."] * (
            len(kinds) if count > named else 0
        )
        assert len(warnings) == len(kinds) * named + len(more)
