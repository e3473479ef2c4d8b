"""evaluate_model and render_report on small artifacts with exact truth."""

import html
import json
import re

import pycolmap
import pytest
from finished_model import COUNT, LOST, NAMES, evaluate, export, report

from snakesfm.pipeline import STAGES
from snakesfm.stages import render_report


def test_evaluation_against_the_exported_truth(tmp_path, problem) -> None:
    truth = export(tmp_path, problem, lost=())
    metrics, row = evaluate(tmp_path, problem, str(truth))
    assert metrics["reference_images"] == COUNT
    assert metrics["reference_images_registered"] == COUNT - 1
    assert metrics["relative_pose_auc_5deg"] == pytest.approx(100 * 8 * 7 / 72, abs=1e-3)
    assert metrics["pose_auc_2.5deg"] == pytest.approx(100 * 8 / 9, abs=1e-3)
    assert metrics["per_image"][NAMES[LOST]]["position_error"] is None
    assert metrics["per_image"][NAMES[0]]["position_error"] == pytest.approx(0.0, abs=1e-6)
    assert float(row["relative_pose_auc_5deg"]) == metrics["relative_pose_auc_5deg"]
    assert set(row) == set(metrics) - {"per_image", "reference"}


def rename(folder, name_of):
    """The model in a folder with other names of its images."""
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    for image in model.images.values():
        image.name = name_of(image.name)
    other = folder.parent / "renamed"
    other.mkdir()
    model.write_binary(str(other))
    return other


def test_errors_of_images_are_shown_whatever_the_reference_calls_them(tmp_path, problem) -> None:
    truth = rename(export(tmp_path, problem, lost=()), lambda name: name.replace(".jpg", ".png"))
    metrics, _ = evaluate(tmp_path, problem, str(truth))
    assert sorted(metrics["per_image"]) == NAMES
    assert metrics["per_image"][NAMES[0]]["reference_name"] == NAMES[0].replace(".jpg", ".png")
    page = report(tmp_path, problem, str(truth))
    row = re.search(rf"<tr><td>{re.escape(html.escape(NAMES[0]))}</td>(.*?)</tr>", page, re.DOTALL)[1]
    assert [float(cell) < 1e-3 for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)[-2:]] == [True, True]


def test_a_reference_of_other_names_has_no_areas_and_is_warned_of(tmp_path, problem, capsys) -> None:
    truth = rename(export(tmp_path, problem, lost=()), lambda name: f"other {NAMES.index(name)}.jpg")
    metrics, row = evaluate(tmp_path, problem, str(truth))
    assert metrics["relative_pose_auc_1deg"] is None and row["relative_pose_auc_1deg"] == ""
    assert f"warning: only 0 of the {COUNT} images of the reference" in capsys.readouterr().err
    assert "relative pose AUC" not in report(tmp_path, problem, str(truth))


def test_evaluation_without_a_reference_has_the_columns_that_need_none(tmp_path, problem) -> None:
    metrics, row = evaluate(tmp_path, problem, "")
    assert metrics["registered_images"] == COUNT - 1
    assert metrics["points"] == len(problem.points)
    assert not [name for name in row if "auc" in name]


def test_report_says_what_happened_and_escapes_names(tmp_path, problem) -> None:
    page = report(tmp_path, problem, str(export(tmp_path, problem, lost=())))
    assert "8 of 9 images registered" in page
    assert "a &lt;scene&gt;" in page
    assert "#<b>" not in page
    assert "#&lt;b&gt;" in page
    assert "no &lt;image&gt;.jpg" in page
    assert "look &lt;here&gt;" in page
    lost = int((problem.pairs == LOST).any(axis=1).sum())
    assert f"None of its {lost} pairs was accepted: too few inliers ({lost})." in page
    assert "cycle_median" in page
    assert "focal lengths: 2 given; median standard deviation 2.0 %" in page
    assert "12.5" in page and "82.5" not in page
    named = [stage for stage in re.findall(r"<tr><td>(\w+)</td>", page) if stage in STAGES]
    assert named == sorted(named, key=STAGES.index)
    assert {"match_pairs", "build_view_graph", "adjust_bundle"} < set(named)
    assert "relative pose AUC" in page
    assert page.count("<title>") >= 2 * 8
    assert "http" not in page.replace("http-equiv", "")
    assert len(page) < 1_000_000


@pytest.mark.parametrize(
    ("outside", "told"), [(0, []), (1, ["1 camera is"]), (1234, ["1,234 cameras are"])]
)
def test_report_says_how_many_cameras_its_maps_leave_out(
    tmp_path, problem, monkeypatch: pytest.MonkeyPatch, outside: int, told: list[str]
) -> None:
    monkeypatch.setattr(render_report, "scene_map", lambda *_: ("", outside))
    page = report(tmp_path, problem, "")
    assert re.findall(r"From above; (.*?) too far away to be shown", page) == told
    assert "From the side" in page


def test_report_without_reference_shows_at_most_the_asked_rows(tmp_path, problem) -> None:
    page = report(tmp_path, problem, "", max_images=3)
    assert "Only the 3 of 9 images with the fewest observations are shown." in page
    assert "relative pose AUC" not in page


def test_a_scene_without_registered_images_is_exported_evaluated_and_reported(tmp_path, problem) -> None:
    everything = range(COUNT)
    truth = export(tmp_path / "truth", problem, lost=())
    folder = export(tmp_path, problem, lost=everything)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    assert (summary["registered_images"], summary["mean_reprojection_error_px"]) == (0, 0.0)
    assert pycolmap.Reconstruction(str(folder / "sparse" / "0")).num_reg_images() == 0
    page = report(tmp_path, problem, str(truth), lost=everything)
    assert "0 of 9 images registered" in page
    assert "No image is registered." in page
    assert "Bundle adjustment dropped it" in page
