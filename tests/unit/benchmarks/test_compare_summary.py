"""The comparison's medians, ratios and tables, on results made up for it."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.compare.__main__ import add_command, write_tables
from benchmarks.compare.ablate import DEFAULT, read_ablations, render_ablations
from benchmarks.compare.measure import Cost
from benchmarks.compare.methods import job_counts, stage_costs
from benchmarks.compare.results import (
    GLOBAL,
    INCREMENTAL,
    OURS,
    OWN,
    PACKAGES,
    SAME,
    Result,
    read_results,
)
from benchmarks.compare.run import Campaign
from benchmarks.compare.summary import COLUMNS, best_peer, gap, group, ratios, speed, spread, tally
from benchmarks.compare.tables import render_csv, render_page
from benchmarks.machine import describe_machine
from snakesfm.errors import ConfigError

AREA = "relative_pose_auc_1deg"
BLANK = Result("castle", 30, True, True, OURS, OWN, 0, date="2026-01-02")


def column(key: str):
    return next(item for item in COLUMNS if item.key == key)


def result(method: str, seed: int, area: float, seconds: float, setting: str = OWN, others: float = 0.0):
    cost = Cost(seconds, 2 * seconds, 100.0 + seed, others)
    stages = {"map": cost} if setting == SAME else {"extract": cost, "map": cost, "total": cost + cost}
    metrics = {AREA: area, "registered_images": 30, "position_error_median": 0.01 * seconds}
    return replace(BLANK, method=method, seed=seed, setting=setting, metrics=metrics, stages=stages)


@pytest.fixture
def results() -> list[Result]:
    ours = [result(OURS, seed, area, 2.0) for seed, area in enumerate((90.0, 92.0, 91.0))]
    incremental = [result(INCREMENTAL, seed, 80.0 + seed, 16.0) for seed in range(3)]
    glomap = [result(GLOBAL, seed, 88.0, 5.0) for seed in range(2)]
    glomap.append(replace(BLANK, method=GLOBAL, seed=2, failure="crashed by SIGSEGV"))
    return [*ours, *incremental, *glomap]


def test_median_and_spread_over_seeds(results: list[Result]) -> None:
    found = spread(column(AREA), [item for item in results if item.method == OURS])
    assert (found.median, found.least, found.greatest) == (91.0, 90.0, 92.0)


def test_a_run_without_a_model_counts_as_nothing_in_accuracy_and_not_in_time(results: list[Result]) -> None:
    runs = [item for item in results if item.method == GLOBAL]
    assert (spread(column(AREA), runs).least, spread(column(AREA), runs).median) == (0.0, 88.0)
    assert spread(column("total_seconds"), runs).median == 10.0
    assert spread(column("position_error_median"), runs).median == pytest.approx(0.05)


def test_ratios_are_to_the_better_peer_and_above_one_where_snakesfm_is_better(
    results: list[Result],
) -> None:
    groups = group(results)
    assert best_peer(column(AREA), groups, "castle", OWN).median == 88.0
    assert best_peer(column("total_seconds"), groups, "castle", OWN).median == 10.0
    assert best_peer(column(AREA), groups, "castle", SAME) is None
    found = ratios(groups, "castle", OWN)
    assert found[AREA] == (pytest.approx(91.0 / 88.0), False)
    assert found["total_seconds"] == (pytest.approx(2.5), False)
    assert found["position_error_median"] == (pytest.approx(2.5), False)
    assert found["points"] is None
    assert gap(AREA, groups, "castle", OWN) == pytest.approx(3.0)
    assert gap(AREA, groups, "castle", SAME) is None
    assert speed("total_seconds", groups, "castle", OWN, INCREMENTAL) == (pytest.approx(8.0), False)


def test_disturbed_timings_count_only_where_there_are_no_others() -> None:
    calm, loud = result(OURS, 0, 90.0, 2.0), result(OURS, 1, 90.0, 9.0, others=0.5)
    seconds = column("total_seconds")
    assert (spread(seconds, [calm, loud]).median, spread(seconds, [calm, loud]).disturbed) == (4.0, False)
    assert (spread(seconds, [loud]).median, spread(seconds, [loud]).disturbed) == (18.0, True)
    louder = result(OURS, 2, 90.0, 12.0, others=0.5)
    assert spread(seconds, [loud, louder]).median == 18.0
    assert spread(column(AREA), [calm, loud]).least == 90.0
    groups = group([calm, result(INCREMENTAL, 0, 80.0, 16.0, others=0.5)])
    assert speed("total_seconds", groups, "castle", OWN, INCREMENTAL) is None
    assert speed("total_cpu_seconds", groups, "castle", OWN, INCREMENTAL) == (8.0, True)
    found = ratios(groups, "castle", OWN)
    assert (found["total_seconds"], found["total_cpu_seconds"]) == (None, (8.0, True))
    assert found[AREA] == (pytest.approx(90.0 / 80.0), False)
    groups = group([loud, result(INCREMENTAL, 0, 80.0, 18.0, others=0.5)])
    assert ratios(groups, "castle", OWN)["total_seconds"] == (2.0, True)
    assert "| *ratio* | ~2 | ~2 | ~2 | ~2 | ~2 | ~2 | 0.99 |" in render_page(
        [*groups["castle", OWN, OURS], *groups["castle", OWN, INCREMENTAL]], "", ["compare"]
    )


def test_what_was_disturbed_is_measured_again_where_that_is_asked_for(tmp_path: Path) -> None:
    calm, loud = result(OURS, 0, 90.0, 2.0), result(INCREMENTAL, 0, 90.0, 9.0, others=0.5)
    other = result(INCREMENTAL, 1, 90.0, 9.0, others=0.5)
    for retime, taken in ((False, [True, True, True]), (True, [True, False, True])):
        campaign = Campaign(tmp_path, 2, 1, 1, 60.0, (OURS,), retime)
        assert not campaign.takes_over(replace(calm, seed=5))
        for item in (calm, loud, other):
            item.write(campaign.results)
        assert [campaign.takes_over(item) for item in (calm, loud, other)] == taken


def test_tally_calls_small_differences_equal() -> None:
    assert tally([0.2, 0.05, -0.1, -0.3, None]) == {"better": 1, "equal": 2, "worse": 1}


def test_snakesfm_takes_part_on_the_same_features_with_its_mapping(
    tmp_path: Path, results: list[Result]
) -> None:
    for item in results:
        item.write(tmp_path)
    assert results[0].stored(tmp_path) == results[0]
    assert replace(results[0], inputs="other").stored(tmp_path) is None
    assert replace(results[0], known=False).stored(tmp_path) is None
    read = read_results(tmp_path)
    shared = [item for item in read if item.setting == SAME]
    assert len(read) == len(results) + 3
    assert {item.method for item in shared} == {OURS}
    assert all(set(item.stages) == {"map"} for item in shared)


def test_what_a_run_takes_beside_its_jobs_is_shared_out_among_them(tmp_path: Path) -> None:
    # 12 images: 2 blocks, 3 tiles; 21 jobs
    assert job_counts(12) == {"extract": 4, "match": 7, "map": 7, "after": 3}
    assert job_counts(200) == {"extract": 6, "match": 21, "map": 7, "after": 3}
    measured = {"extract": 5.0, "match": 2.0, "map": 0.5, "total": 9.6}
    stages = {name: Cost(1.0, seconds, 10.0) for name, seconds in measured.items()}
    ours = replace(BLANK, images=12, stages=stages)
    peer = replace(ours, method=GLOBAL)
    failed = replace(ours, seed=1, failure="stopped", stages={"failed": Cost(1.0, 2.0, 3.0)})
    for item in (ours, peer, failed):
        item.write(tmp_path)
    assert ours.stored(tmp_path) == ours
    read = {(item.method, item.setting, item.seed): item.stages for item in read_results(tmp_path)}
    shared = {name: cost.cpu_seconds for name, cost in read[OURS, OWN, 0].items()}
    assert shared == {"extract": 5.4, "match": 2.7, "map": 1.2, "total": 9.6}
    assert read[OURS, OWN, 0]["map"].seconds == 1.0
    assert read[OURS, SAME, 0] == {"map": read[OURS, OWN, 0]["map"]}
    assert (read[GLOBAL, OWN, 0], read[OURS, OWN, 1]) == (peer.stages, failed.stages)
    # rounding can make the parts more than the whole
    stages["total"] = Cost(1.0, 7.0, 10.0)
    replace(ours, stages=stages).write(tmp_path)
    assert {item.stages["map"].cpu_seconds for item in read_results(tmp_path) if item.seed == 0} == {0.5}


def test_page_and_csv_hold_what_was_measured(results: list[Result]) -> None:
    shared = [replace(item, setting=SAME) for item in results if item.method == OURS]
    peers = [result(GLOBAL, seed, 93.0, 1.0, SAME) for seed in range(3)]
    page = render_page([*results, *shared, *peers], "cores 2", ["compare --seeds 3"])
    assert "Measured 2026-01-02 with `compare --seeds 3`\non cores 2.\n\n" in page
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines()]
    (gaps,) = [cells for cells in rows if cells[:1] == ["castle*"]]
    assert (gaps[1], gaps[4], gaps[5]) == ("+3.00", "+0", "-2.00")
    (speeds,) = [cells for cells in rows if cells[:2] == ["castle", "30"]]
    # wall and processor time against incremental, GLOMAP and openMVG; then mapping
    assert speeds[2:] == ["8.0x", "2.5x", "", "8.0x", "2.5x", "", "0.5x", "", "0.5x", ""]
    assert (
        "(a) own front-end, independent references: better / equal (within 0.1) / worse in AUC: @1 1 / 0 / 0"
        in page
    )
    assert "| snakesfm | 30 | 91.00 (90.00..92.00) |" in page
    assert "colmap_global: 1 of 3 runs without a model (crashed by SIGSEGV)." in page
    runs = list(csv.DictReader(io.StringIO(render_csv(results))))
    assert len(runs) == len(results)
    assert {row["failure"] for row in runs} == {"", "crashed by SIGSEGV"}
    assert float(runs[0][AREA]) == 90.0


def test_the_page_names_the_machines_and_commands_of_the_results_not_of_who_renders_them(
    tmp_path: Path, results: list[Result]
) -> None:
    ours, other = results[0], replace(results[3], image_set="door", date="2026-01-05")
    ours.write(tmp_path / "results")
    # as those were stored that had no machine
    file = ours.path(tmp_path / "results")
    stored = json.loads(file.read_text())
    del stored["machine"]
    file.write_text(json.dumps(stored))
    for command in ("compare --sets castle", "compare --sets door", "compare --sets castle"):
        add_command(tmp_path, command)
    write_tables(tmp_path, None)
    here = describe_machine(PACKAGES)
    commands = "`compare --sets castle`, `compare --sets door`"
    page = (tmp_path / "benchmarks.md").read_text()
    assert f"Measured 2026-01-02 with {commands}\non {here}.\n\n" in page
    replace(other, machine="cores 64").write(tmp_path / "results")
    write_tables(tmp_path, tmp_path / "own.md")
    page = (tmp_path / "own.md").read_text()
    assert f"Measured 2026-01-02 to 2026-01-05 with {commands}\n" in page
    assert f"\n\n- {here}: castle\n- cores 64: door\n\n" in page


def test_stage_costs_are_read_from_the_last_run_in_the_logs(tmp_path: Path) -> None:
    def log(stage: str, *lines: str) -> None:
        file = tmp_path / "logs" / stage / "job.log"
        file.parent.mkdir(parents=True)
        file.write_text("".join(f"2026-01-02T10:{line}\n" for line in lines))

    log(
        "index_images",
        "00:00.000 index_images out/index.h5",
        "00:01.000 index_images done in 1.00 s, 0.50 s of processor time, 96 MB at most",
        "10:00.000 index_images out/index.h5",
        "10:02.000 index_images done in 2.00 s, 1.50 s of processor time, 96 MB at most",
    )
    log(
        "match_pairs",
        "10:03.000 match_pairs out/0-0.h5",
        "10:09.500 match_pairs done in 6.50 s, 6.00 s of processor time, 96 MB at most",
    )
    log(
        "adjust_bundle",
        "10:10.000 adjust_bundle out/reconstruction.h5",
        "10:12.000 adjust_bundle done in 2.00 s, 1.75 s of processor time, 96 MB at most",
    )
    costs = stage_costs(tmp_path / "logs", Cost(20.0, 12.0, 300.0))
    assert {name: (cost.seconds, cost.cpu_seconds, cost.peak_mib) for name, cost in costs.items()} == {
        "extract": (2.0, 1.5, 96.0),
        "match": (7.5, 6.0, 96.0),
        "map": (2.5, 1.75, 96.0),
    }


def test_ablations_change_known_options_and_go_from_late_stages_to_early_ones(
    root: Path, tmp_path: Path
) -> None:
    ablations = read_ablations(root / "benchmarks" / "ablations.yaml", [])
    assert ablations[0].name == DEFAULT
    places = [ablation.first_stage for ablation in ablations]
    assert places == sorted(places, reverse=True)
    file = tmp_path / "own.yaml"
    file.write_text("slip: {adjust_bundle: {los: huber}}\n")
    with pytest.raises(ConfigError, match=r"'slip': Unknown configuration key 'adjust_bundle\.los'"):
        read_ablations(file, [])
    with pytest.raises(ConfigError, match="has no 'nothing'"):
        read_ablations(root / "benchmarks" / "ablations.yaml", ["nothing"])


def test_table_of_ablations_shows_mean_changes() -> None:
    areas = {"a|default": 90.0, "a|x": 91.0, "b|default": 50.0, "b|x": None}
    page = render_ablations(areas, ["default", "x"], {"a": True, "b": False}, "2026-01-02")
    assert "| x | -24.50 | +1.00 | 91.00 | failed |" in page
    assert "| default |  |  | 90.00 | 50.00 |" in page
