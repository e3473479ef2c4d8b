"""What a run does to the output folder before its jobs, and says of its results after them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snakesfm.artifacts import Header, ImagePairs, checks, write_json
from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.errors import ConfigError
from snakesfm.evaluation.metrics import Poses, evaluate_poses
from snakesfm.plan import Plan
from snakesfm.records import split_words
from snakesfm.run import Run


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plan:
    """Of two images, in a folder where Snakemake has no records."""
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        Path("images", name).write_bytes(name.encode())
    return Plan({"images": "images", "output": "out", "scene": "s"})


def start_and_end(plan: Plan) -> None:
    """A run takes the output folder's lock, and the system frees it."""
    run = Run(plan)
    try:
        run.start()
    finally:
        run.lock.close()


def test_no_other_run_starts_while_files_are_set_aside(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    start_and_end(plan)
    file = Path("out/s/select_pairs/0-0.h5")
    ImagePairs([[0, 1]], ["listed"], [0.5], [2.0]).write(file, Header("select_pairs", 0, "s"))
    set_aside: Callable[..., list[str]] = checks.set_aside

    def start_another_first(*arguments: Any) -> list[str]:
        with pytest.raises(ConfigError, match="Another run"):
            start_and_end(plan)
        return set_aside(*arguments)

    monkeypatch.setattr(checks, "set_aside", start_another_first)
    Run(plan).refuse_unrecorded({"all"})
    assert "1 files without a record" in capsys.readouterr().out
    assert [path.name for path in file.parent.iterdir()] == ["0-0.h5.refused"]
    start_and_end(plan)


@pytest.mark.parametrize(
    ("arguments", "stays"),
    [
        ("--until build_tracks", True),
        ("--until=build_tracks", True),
        ("-Ubuild_tracks", True),
        ("-kU build_tracks", True),
        ("--omit-from=export_model", True),
        ("--cores=all -R build_tracks", False),
        ("-Rbuild_tracks", False),
        ("databases --cores=all", True),
        ("-call databases", True),
        ("all databases", False),
    ],
)
def test_an_unrecorded_model_is_made_again_where_all_is_made(
    plan: Plan, arguments: str, stays: bool
) -> None:
    summary = Path("out/s/export_model/summary.json")
    summary.parent.mkdir(parents=True)
    summary.touch()
    made = summary.stat().st_mtime
    assert made > 1
    Run(plan).refuse_unrecorded(split_words(arguments.split()))
    assert summary.stat().st_mtime == (made if stays else 1)


def say_accuracy(plan: Plan, metrics: dict[str, Any]) -> str:
    """The last line of a run whose model has these metrics."""
    model = {"registered_images": 4, "images": 4, "points": 9, "mean_reprojection_error_px": 0.5}
    write_json(Path("out/s/export_model/summary.json"), model)
    write_json(Path("out/s/evaluate_model/metrics.json"), metrics)
    return Run(plan).describe(plan.scenes["s"])


@pytest.mark.parametrize(
    ("thresholds_deg", "said"),
    [
        ((20.0, 1.0, 10.0), "relative-pose AUC 50.0/67.9/84.0 at 1/10/20 deg"),
        ((2.5,), "relative-pose AUC 50.0 at 2.5 deg"),
    ],
)
def test_accuracy_is_said_at_the_thresholds_that_it_was_evaluated_at(
    plan: Plan, thresholds_deg: tuple[float, ...], said: str
) -> None:
    names = [f"{k}.jpg" for k in range(4)]
    centers = np.random.default_rng(0).normal(size=(4, 3))
    reference = Poses(names, np.tile(np.eye(3), (4, 1, 1)), -centers)
    angle = np.radians(7.0)
    turned = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    # one of four images is turned on the spot: half of the pairs are exact, the others off by 7 degrees
    rotations, translations = reference.rotations.copy(), -centers
    rotations[0], translations[0] = turned, turned @ translations[0]
    model = Poses(names, rotations, translations)
    options = EvaluateModelOptions(relative_thresholds_deg=thresholds_deg).model_dump()
    assert f", {said}, " in say_accuracy(plan, evaluate_poses(model, reference, **options).metrics)


def test_without_a_reference_nothing_is_said_of_accuracy(plan: Plan) -> None:
    assert "AUC" not in say_accuracy(plan, {"scene": "s", "registered_images": 4})
