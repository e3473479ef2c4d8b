"""The table of front-ends says what was measured, and what was not."""

import json
import shutil
from pathlib import Path

import pytest

from benchmarks.compare.sets import ImageSet
from benchmarks.front_ends import COMPARED, DEGREES, ORACLE, USUAL, options_of, render
from benchmarks.on_sets import Run, SetTable


def value(area: float) -> dict:
    areas = {f"pose_auc_{degrees}deg": area for degrees in DEGREES}
    counts = {"reference_images": 5, "reference_images_registered": 4, "track_length_mean": 3.26}
    return {**counts, "cpu_seconds": 12.4, **areas}


def test_rows_means_failures_and_gaps() -> None:
    values = {
        "a|sift": value(80.0),
        "a|disk+lightglue": value(70.0),
        "a|virtual": {"failure": "no points"},
        "b|sift": value(60.0),
        "b|disk+lightglue": {"failure": "no memory"},
    }
    text = render(values, ["a", "b"], ["sift", "disk+lightglue", "virtual"])
    assert "| sift | 80.0 | 80.0 | 80.0 | 80.0 | 80.0 | 4 of 5 | 3.3 | 12 |" in text
    assert "| disk+lightglue | no memory |" in text and "| virtual | no points |" in text
    # only set a was finished by both, and the oracle takes no part
    assert "## Mean of 1 sets" in text and text.count("| sift | 80.0") == 2
    assert text.count("| virtual |") == 2 and "not run" in render({}, ["a"], ["sift"])


def test_the_oracle_spreads_points_where_a_reference_has_none(small_scene: Path, tmp_path: Path) -> None:
    assert ORACLE in USUAL and set(USUAL) <= set(COMPARED) and "imported" not in COMPARED
    shutil.copytree(small_scene, tmp_path / "a")
    image_set = ImageSet(tmp_path / "a", False, False)
    assert options_of(ORACLE, image_set) == ["front_end=virtual"]
    (tmp_path / "a" / "reference" / "points3D.txt").write_text("")
    for file in (tmp_path / "a" / "reference").glob("points3D.bin"):
        file.unlink()
    assert options_of(ORACLE, image_set) == ["front_end=virtual", "extract_features={view_points: 300}"]
    assert options_of("sift", image_set) == ["front_end=sift"]


def test_what_is_there_is_not_measured_again(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for name in ("one", "two"):
        shutil.copytree(small_scene, tmp_path / name)
    measured, broken = [], [True]

    def count(image_set: ImageSet, method: str, run: Run) -> dict:
        measured.append((image_set.name, method, run.options, run.threads))
        return {"failure": "broken"} if broken[0] and method == "y" else {"found": len(measured)}

    def show(values: dict, sets: list, methods: list) -> str:
        return json.dumps([values, list(sets), list(methods)])

    page = Path(__file__).resolve().parents[2] / "docs" / "none.md"
    table = SetTable("mine", "text", page, "--methods", ["x", "y"], ["x", "y"], count, show)
    command = ["--out", str(tmp_path / "out"), "--data", str(tmp_path), "--threads", "1"]
    command += ["--weights", str(tmp_path), "--options", "seed=1"]
    assert table.main(command) == 0
    options = (f"weights={tmp_path}", "seed=1")
    assert measured == [(name, method, options, 1) for name in ("one", "two") for method in ("x", "y")]
    broken[0] = False
    assert table.main([*command, "--sets", "two"]) == 0
    assert measured[4:] == [("two", "y", options, 1)]
    shown, _, said = (tmp_path / "out" / "mine.md").read_text().partition("\n")
    values, sets, methods = json.loads(shown)
    assert said == "Options of the workflow: `seed=1`, all others default.\n"
    assert (sets, methods) == (["two"], ["x", "y"]) and not page.exists()
    assert values["two|y"].pop("inputs") and values["two|y"] == {"found": 5}
    assert values["one|y"].pop("inputs") and values["one|y"] == {"failure": "broken"}
    # what was measured with other options is another result
    del measured[:]
    assert table.main([*command[:-2], "--sets", "two"]) == 0
    assert [options for _, _, options, _ in measured] == [(f"weights={tmp_path}",)] * 2
    assert (tmp_path / "out" / "mine.md").read_text().endswith("Options of the workflow: default.\n")
    assert table.main([*command, "--sets", "three"]) == 1
    assert "is not an image set" in capsys.readouterr().err
