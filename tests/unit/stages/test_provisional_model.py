"""Focal lengths that a quick model of the strongest pairs revises."""

from dataclasses import replace

import numpy as np
import pytest
from plain_artifacts import write_plain_matches
from synthetic_scene import write_scene

from snakesfm.artifacts import CalibratedCameras
from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions
from snakesfm.pipeline import STAGES
from snakesfm.scene_plan import PROVISIONAL_STAGES
from snakesfm.stages import calibrate_cameras
from snakesfm.stages.job import StageJob
from snakesfm.stages.provisional_model import STEPS
from snakesfm.synthetic.problems import make_problem

COUNT = 12
FACTORS = np.exp(np.random.default_rng(5).normal(0.0, 0.3, COUNT))


@pytest.fixture(scope="module")
def made():
    """A camera of its own for every image."""
    made = make_problem(COUNT, 600, "ring", noise_px=0.3, seed=7)
    return replace(made, cameras=tuple(made.cameras) * COUNT, camera_ids=np.arange(COUNT))


def job_of(made, folder, **options):
    inputs = write_scene(made, folder)
    of_pair = np.split(made.matches, made.match_offsets[1:-1])
    write_plain_matches(folder / "matches.h5", made.pairs, of_pair)
    inputs = {name: inputs[name] for name in ("index", "features")} | {"matches": folder / "matches.h5"}
    options = CalibrateCamerasOptions(**options)
    return StageJob("calibrate_cameras", "scene", inputs, (folder / "out.h5",), options, threads=2)


def calibrate(monkeypatch, made, folder, factors, sigma, **options):
    """Focal lengths in those of the truth, and the stage's file, if the pairs say so wrong ones."""

    def estimated(job, index, cameras, matched, covered):
        found = [
            camera.with_focal(camera.focal_px * factor, "estimated")
            for camera, factor in zip(made.cameras, factors, strict=True)
        ]
        return found, np.full(COUNT, sigma), np.full(COUNT, 5, np.int32)

    monkeypatch.setattr(calibrate_cameras, "_calibrate", estimated)
    unknown = replace(made, cameras=tuple(replace(camera, source="default") for camera in made.cameras))
    job = job_of(unknown, folder, **options)
    calibrate_cameras.run(job)
    found = CalibratedCameras.read(job.output)
    return found.params[:, 0] / made.cameras[0].params[0], found


def test_estimates_far_from_what_the_model_says_are_revised(monkeypatch, made, tmp_path, capsys):
    ratios, found = calibrate(monkeypatch, made, tmp_path, FACTORS, 0.05)
    before, after = np.abs(np.log(FACTORS)), np.abs(np.log(ratios))
    assert np.median(after) < 0.03 and np.median(before) > 0.2
    assert after.max() < 0.15
    assert found.sources.tolist() == ["estimated"] * COUNT
    # the estimates' deviations are refuted
    assert np.isnan(found.focal_sigma).all()
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == []
    assert "its cameras are used" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("factors", "sigma", "options"),
    [
        (FACTORS, 0.5, {}),  # as far off as they are said to be
        (np.ones(COUNT), 0.05, {}),
        (FACTORS, 0.05, {"min_revision_sigmas": 100.0}),
        (FACTORS, 0.05, {"provisional_model": False}),
    ],
)
def test_estimates_that_agree_stay_as_they_are(
    monkeypatch, made, tmp_path, capsys, factors, sigma, options
):
    ratios, _ = calibrate(monkeypatch, made, tmp_path, factors, sigma, **options)
    np.testing.assert_allclose(ratios, factors, rtol=1e-12)
    said = "its cameras are not needed" in capsys.readouterr().out
    assert said == options.get("provisional_model", True)


def test_images_of_one_camera_have_no_provisional_model(monkeypatch, made, tmp_path, capsys):
    one = replace(made, cameras=made.cameras[:1], camera_ids=np.zeros(COUNT, int))
    monkeypatch.setattr(
        calibrate_cameras,
        "_calibrate",
        lambda *_: (list(one.cameras), np.full(1, 0.05), np.full(1, 5, np.int32)),
    )
    job = job_of(replace(one, cameras=(replace(one.cameras[0], source="default"),)), tmp_path)
    calibrate_cameras.run(job)
    assert "provisional" not in capsys.readouterr().out


def test_what_exif_tells_stays(monkeypatch, made, tmp_path, capsys):
    ratios, found = calibrate(monkeypatch, made, tmp_path, FACTORS, CalibrateCamerasOptions().exif_sigma)
    np.testing.assert_allclose(ratios, FACTORS, rtol=1e-12)
    assert np.isfinite(found.focal_sigma).all()
    assert "provisional" not in capsys.readouterr().out


def test_implausible_focal_lengths_stay(monkeypatch, made, tmp_path):
    ratio = made.cameras[0].focal_px / max(made.cameras[0].width, made.cameras[0].height)
    ratios, _ = calibrate(monkeypatch, made, tmp_path, FACTORS, 0.05, max_focal_ratio=0.8 * ratio)
    np.testing.assert_allclose(ratios, FACTORS, rtol=1e-12)


def test_without_a_model_the_estimates_stay(monkeypatch, made, tmp_path, capsys):
    ratios, _ = calibrate(monkeypatch, made, tmp_path, FACTORS, 0.05, min_matches=10_000)
    assert np.median(np.abs(np.log(ratios / FACTORS))) < 1e-9
    assert "no provisional model: No two images" in capsys.readouterr().out


def test_its_stages_are_those_of_the_model():
    assert tuple(STEPS) == PROVISIONAL_STAGES
    assert set(STEPS) < set(STAGES)
