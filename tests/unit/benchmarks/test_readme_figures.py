"""The figures of the README and of the overview are those of the measured results in docs/."""

import re
from pathlib import Path

import pandas
import pytest

from benchmarks.compare.results import GLOBAL, INCREMENTAL, OPENMVG, OURS, OWN

ROOT = Path(__file__).resolve().parents[3]
PAGES = "\n".join(
    (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/benchmarks_overview.md")
)
TEXT = " ".join(PAGES.split())
METHODS = [OURS, INCREMENTAL, GLOBAL]
SETS = {
    "Vesta": "astrovision_vesta_4",
    "Reichstag": "imc_reichstag_10",
    "entry-P10": "strecha_entry_p10",
    "fountain-P11": "strecha_fountain_p11",
    "Lund door": "olsson_lund_door",
    "castle-P19": "strecha_castle_p19",
    "castle-P30": "strecha_castle_p30",
    "temple ring": "middlebury_temple_ring",
    "KITTI": "kitti_seq2_51",
    "Statue of Liberty": "statue_of_liberty_135",
    "Seneca": "seneca_aerial_167",
    "7-Scenes": "sevenscenes_redkitchen_200",
}


def medians(page: str, image_set: str) -> pandas.DataFrame:
    """Medians over the seeds of each method with its own front-end; runs without a model are 0."""
    runs = pandas.read_csv(ROOT / "docs" / f"{page}.csv")
    runs = runs[(runs.image_set == image_set) & (runs.setting == OWN)]
    return runs.fillna({"registered_images": 0}).groupby("method").median(numeric_only=True)


def row_of(start: str) -> list[str]:
    """The cells of the only row that starts so."""
    (row,) = [line for line in PAGES.splitlines() if line.startswith(f"| {start}")]
    return [cell.strip(" *") for cell in row.strip("|").split("|")]


@pytest.mark.parametrize("name", list(SETS)[:9])
def test_accuracy_and_time_with_independent_references(name):
    _, images, *figures = row_of(name)
    measured = medians("benchmarks", SETS[name])
    assert measured.images[OURS] == int(images)
    for method, accuracy, seconds in zip(METHODS, figures[:3], figures[3:], strict=True):
        if accuracy == "no model":
            assert measured.registered_images[method] == 0
            assert seconds == ""
        else:
            assert float(accuracy) == pytest.approx(measured.relative_pose_auc_1deg[method], abs=0.051)
            assert float(seconds) == pytest.approx(measured.total_cpu_seconds[method], abs=0.51)


def test_total_seconds_of_the_large_sets():
    found = re.findall(r"\(([^()]+)\) (\d+) / (\d+) / (\d+)", TEXT)
    assert len(found) == 3
    for name, *seconds in found:
        measured = medians("benchmarks", SETS[name])
        for method, shown in zip(METHODS, seconds, strict=True):
            assert float(shown) == pytest.approx(measured.total_seconds[method], abs=0.51)


def test_photographs_of_full_resolution():
    methods = [*METHODS, OPENMVG]
    measured = medians("benchmarks_large", "courtyard_4000")
    for start, column, step in (
        ("total seconds", "total_seconds", 1),
        ("AUC@1 |", "relative_pose_auc_1deg", 0.01),
    ):
        for method, shown in zip(methods, row_of(start)[1:], strict=True):
            assert float(shown) == pytest.approx(measured[column][method], abs=0.51 * step)


@pytest.mark.parametrize(
    ("label", "image_set"),
    [
        ("a quarter of castle-P30", "strecha_castle_p30_every_4"),
        ("a quarter of the temple ring", "middlebury_temple_ring_every_4"),
    ],
)
def test_photographs_that_overlap_little(label, image_set):
    measured = medians("benchmarks_thinned", image_set)
    for method, shown in zip(METHODS, row_of(label)[1:], strict=True):
        images, areas = shown.split(", ")
        assert int(images) == measured.registered_images[method]
        for degrees, area in zip((1, 3, 5), areas.split("/"), strict=True):
            assert float(area) == pytest.approx(
                measured[f"relative_pose_auc_{degrees}deg"][method], abs=0.51
            )


def test_openmvg_is_faster_and_less_accurate_as_the_pages_say():
    lacks = {}
    for name in list(SETS)[:9]:
        measured = medians("benchmarks", SETS[name])
        assert measured.total_seconds[OPENMVG] < 0.75 * measured.total_seconds[OURS]
        areas = measured.relative_pose_auc_1deg
        lacks[name] = areas[OURS] - areas[OPENMVG]
    assert min(lacks.values()) > 0
    assert {name for name, lack in lacks.items() if lack < 2} == {"fountain-P11", "KITTI"}
    far = {"Reichstag", "castle-P19", "castle-P30", "temple ring"}
    assert {name for name, lack in lacks.items() if lack > 25} == far
    every = pandas.read_csv(ROOT / "docs" / "benchmarks.csv").image_set.unique()
    models = []
    for image_set in every:
        measured = medians("benchmarks", image_set)
        if OPENMVG in measured.index and measured.registered_images[OPENMVG] > 0:
            models.append(image_set)
            assert measured.total_seconds[OPENMVG] < measured.total_seconds[OURS]
            assert measured.relative_pose_auc_1deg[OPENMVG] < measured.relative_pose_auc_1deg[OURS]
    assert len(models) > 5 and SETS["Statue of Liberty"] not in models


@pytest.mark.parametrize(
    ("label", "shown"),
    [
        ("all sets", "better at 1 degree on {}, equal (within 0.1) on {} and worse on {}"),
        ("independent references", "better on {}, equal on {} and worse on {}"),
    ],
)
def test_where_photographs_overlap_little_the_overview_has_the_tallies_of_the_page(label, shown):
    page = (ROOT / "docs" / "benchmarks_thinned.md").read_text(encoding="utf-8")
    tally = re.search(rf"\(a\) own front-end, {label}: .*?@1 (\d+) / (\d+) / (\d+)", page).groups()
    assert shown.format(*tally) in TEXT
