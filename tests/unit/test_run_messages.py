"""What a run sets aside and locks at its start, and what it says of its scenes in the end."""

import datetime
import json
import os
import time
from collections.abc import Iterator, Set
from pathlib import Path
from types import SimpleNamespace

import pytest
from snakemake.common.configfile import load_configfile
from snakemake_interface_executor_plugins.settings import SharedFSUsage

from snakesfm import slurm
from snakesfm.errors import ConfigError
from snakesfm.job_logs import describe_cost, describe_failures
from snakesfm.model_files import MODEL_FILES
from snakesfm.plan import Plan
from snakesfm.run import CONFIGURATION_NAME, IMAGE_COUNTS, LOCK_NAME, Run

MODEL = {"export_model", "evaluate_model"}
SUMMARY = {"images": 9, "registered_images": 5, "points": 321, "mean_reprojection_error_px": 0.5}
NOT_FINISHED = "snakesfm: scene 'scene' is not finished: start the same command again."
SEE_ABOVE = NOT_FINISHED[:-1] + "; if jobs failed, Snakemake's messages above say why."
WITH_MORE = NOT_FINISHED[:-1] + (
    "; if memory or time ran out, request more in set-resources of the profile: "
    "RULE: {mem_mb: MB, runtime: MINUTES}."
)
WITH_FEWER_JOBS = (
    NOT_FINISHED[:-1] + "; if memory ran out, with fewer jobs at once: --cores N or --resources mem_mb=MB."
)
METRICS = {f"relative_pose_auc_{degrees}deg": 90.0 + degrees for degrees in (1, 3, 5)}


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plan:
    """A plan of three images, in a folder without Snakemake's records."""
    monkeypatch.chdir(tmp_path)
    Path("scene").mkdir()
    for number in range(3):
        Path("scene", f"{number}.jpg").write_bytes(b"image %d" % number)
    return Plan({"images": "scene", "output": "out"})


@pytest.fixture
def run(plan: Plan) -> Iterator[Run]:
    """A run that has started."""
    started = Run(plan)
    started.start()
    yield started
    started.lock.close()


LOOKED_AT = {Path(name).name for name in MODEL_FILES} | {"metrics.json", "metrics.csv", "index.html"}


def write(path: str | Path, text: str = "") -> Path:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)
    return Path(path)


@pytest.mark.parametrize(
    ("asked", "forgotten"),
    [
        ({"out"}, LOOKED_AT),
        ({"databases"}, {"database.db"}),
        ({"hloc"}, {"features.h5", "matches.h5", "pairs.txt"}),
        ({"databases", "all"}, {"database.db"} | LOOKED_AT),
        ({"--until", "match_pairs"}, set()),
        ({"-U", "match_pairs"}, set()),
        ({"--omit-from", "export_model"}, set()),
        ({"-O", "export_model"}, set()),
        ({"--drop-metadata"}, set()),
    ],
)
def test_unrecorded_results_are_made_again_where_they_are_asked_for(
    plan: Plan, asked: set[str], forgotten: set[str]
) -> None:
    (scene,) = plan.scenes.values()
    files = [write(path) for path in (*scene.final_files(), scene.database_file(), *scene.hloc_files())]
    Run(plan).refuse_unrecorded(asked)
    assert {file.name for file in files if file.stat().st_mtime == 1} == forgotten


def test_a_run_holds_its_folder_from_start_to_end(plan: Plan, run: Run) -> None:
    (scene,) = plan.scenes.values()
    result = write(scene.final_files()[0])
    second = Run(plan)
    for refused in (second.start, lambda: second.refuse_unrecorded(set())):
        with pytest.raises(ConfigError, match=rf"Another run \(process {os.getpid()} on \S+\) is writing"):
            refused()
    second.lock.close()
    # nothing is touched that another run may be writing
    assert result.stat().st_mtime > 1
    run.finish({})
    # or the next run would look for jobs of this one
    assert Path("out", LOCK_NAME).read_text() == ""
    run.lock.close()
    second.start()
    second.lock.close()


def test_a_lock_that_outlives_its_machine_names_the_way_out(plan: Plan, run: Run) -> None:
    path = Path("out", LOCK_NAME)
    for note, steps in (
        ("process 1 on n1", ""),
        ("process 1 on n1, SLURM run a-b", "run 'scancel --name=a-b' and "),
    ):
        path.write_text(note)
        second = Run(plan)
        with pytest.raises(ConfigError) as refused:
            second.start()
        assert str(refused.value).endswith(f"; if its machine is down for good, {steps}delete {path}.")
        second.lock.close()
    path.unlink()
    second.start()
    second.lock.close()


@pytest.mark.parametrize("ends", [True, False])
def test_an_interrupted_run_leaves_no_slurm_job(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, ends: bool
) -> None:
    left, cancelled = ["7", "8"], []

    def end_jobs(name: str, output: str, lock: str) -> int:
        cancelled.append(name)
        if not ends:
            raise ConfigError(f"SLURM jobs of an interrupted run may still write to '{output}'.")
        count = len(left)
        left.clear()
        return count

    monkeypatch.setattr(slurm, "list_jobs", lambda name: left)
    run = Run(plan)
    run.start("name")
    monkeypatch.setattr(slurm, "end_jobs", end_jobs)
    # the next run cancels jobs of one that ended in another way
    run.fail({}, {"scene"}, on_one_machine=False)
    assert cancelled == [] and "SLURM run name" in Path("out", LOCK_NAME).read_text()
    run.note_interrupt()
    capsys.readouterr()
    run.fail({}, {"scene"}, on_one_machine=False)
    said = "2 SLURM jobs of an interrupted run were cancelled." if ends else "may still write to 'out'."
    first, last = capsys.readouterr().out.splitlines()
    assert first.endswith(said) and last == NOT_FINISHED
    assert cancelled == ["name"]
    assert ("SLURM run name" in Path("out", LOCK_NAME).read_text()) != ends
    run.lock.close()


def workflow_of(local_exec: bool, shared: Set[SharedFSUsage]) -> SimpleNamespace:
    """Snakemake's workflow as far as it matters to the configuration, which is from a file."""
    return SimpleNamespace(
        local_exec=local_exec,
        storage_settings=SimpleNamespace(shared_fs_usage=shared),
        config_settings=SimpleNamespace(configfiles=[Path("/elsewhere/mine.yaml")]),
    )


def test_jobs_of_a_cluster_read_the_configuration_that_the_run_keeps(plan: Plan) -> None:
    scenes = {2024: {"images": "scene"}, True: {"images": "./scene"}}
    config = {
        "output": datetime.date(2024, 5, 1),
        "scenes": scenes,
        "adjust_bundle": {"thresholds_px": [9.0, 3]},
        "blocks": 3,
    }
    run = Run(Plan(config))
    run.start()
    workflow = workflow_of(False, SharedFSUsage.all())
    run.keep_configuration(workflow)
    run.lock.close()
    # they are of the next run
    for number in range(61):
        write(f"scene/late_{number}.jpg")
    kept = Path("2024-05-01", CONFIGURATION_NAME).absolute()
    assert workflow.config_settings.configfiles == [kept]
    assert {file.name for file in kept.parent.iterdir()} == {LOCK_NAME, CONFIGURATION_NAME}
    told = load_configfile(kept)
    again = Plan(told, image_counts=told.pop(IMAGE_COUNTS))
    assert [scene.image_count for scene in again.scenes.values()] == [3, 3]
    assert again.configuration == run.plan.configuration
    assert sorted(again.scenes) == ["2024", "True"]
    assert again.scenes["True"].images == run.plan.scenes["True"].images


@pytest.mark.parametrize(
    ("local_exec", "shared"),
    [
        (True, SharedFSUsage.all()),
        (False, frozenset()),
        (False, SharedFSUsage.all() - {SharedFSUsage.SOURCES}),
        (False, SharedFSUsage.all() - {SharedFSUsage.INPUT_OUTPUT}),
    ],
)
def test_the_files_of_configuration_stay_where_jobs_parse_or_share_none(
    run: Run, local_exec: bool, shared: Set[SharedFSUsage]
) -> None:
    workflow = workflow_of(local_exec, shared)
    run.keep_configuration(workflow)
    assert workflow == workflow_of(local_exec, shared)
    assert not Path("out", CONFIGURATION_NAME).exists()


def test_failed_jobs_are_told_by_their_logs(run: Run, capsys: pytest.CaptureFixture) -> None:
    former = write("out/scene/logs/match_pairs/9-9.log", "error: of the run before\n")
    os.utime(former, (1, 1))
    cost = describe_cost("match_pairs", 1.0, 2.0, 2.0, 90.0)
    write("out/scene/logs/match_pairs/0-0.log", f"12 pairs\n{cost}\n")
    write("out/scene/logs/match_pairs/0-1.log", "12 pairs\n")
    write("out/scene/logs/match_pairs/1-1.log", "12 pairs\nerror: It is full.\n")
    capsys.readouterr()
    run.fail({}, {"scene"})
    killed, failed, again = capsys.readouterr().out.splitlines()
    assert "scene 'scene' failed: match_pairs 0-1 was killed from outside" in killed
    log = "(log: out/scene/logs/match_pairs/1-1.log)"
    assert failed == f"snakesfm: scene 'scene' failed: It is full. {log}"
    assert again == WITH_FEWER_JOBS
    line = "SQLite error: database or disk is full\n" + 40 * "    @ main\n"
    full = write("out/scene/logs/export_database/job.log", line)
    run.fail({}, {"scene"})
    assert "export_database job ended as the disk is full: free the disk" in capsys.readouterr().out
    full.unlink()
    for number in range(12):
        write(f"out/scene/logs/extract_features/{number}.log", f"error: {number}\n")
    run.fail({}, {"scene"})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 12
    assert lines[-2:] == ["snakesfm: scene 'scene' failed: 4 more jobs.", WITH_FEWER_JOBS]
    run.fail({}, {"scene"}, on_one_machine=False)
    assert capsys.readouterr().out.splitlines()[-1] == WITH_MORE
    # as where SLURM takes no job
    run.begun = time.time() + 60
    run.fail({}, {"scene"}, on_one_machine=False)
    assert capsys.readouterr().out.splitlines() == [SEE_ABOVE]


@pytest.mark.parametrize("ahead_s", [-120.0, 120.0])
def test_logs_of_a_run_are_told_by_the_clock_of_their_file_system(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, ahead_s: float
) -> None:
    former = write("out/scene/logs/match_pairs/0-0.log", "error: of the run before\n")
    minute_ago = time.time() - 60
    os.utime(former, (minute_ago, minute_ago))
    # of the machine that the run is started on
    monkeypatch.setattr("snakesfm.run.time", SimpleNamespace(time=lambda: time.time() + ahead_s))
    run = Run(plan)
    # which asks for nanoseconds too
    monkeypatch.setattr(run, "_bring_times_back", lambda: None)
    run.start()
    write("out/scene/logs/match_pairs/0-1.log", "error: It is full.\n")
    (sentence,) = describe_failures(Path("out", "scene", "logs"), run.begun, False)
    run.lock.close()
    assert sentence.startswith("It is full.")


def test_the_next_step_is_said_of_what_failed_by_no_fault_of_its_own(
    run: Run, capsys: pytest.CaptureFixture
) -> None:
    log = write("out/scene/logs/match_pairs/0-0.log", "12 pairs\n")
    run.note_interrupt()
    capsys.readouterr()
    # jobs die by the interrupt too
    run.fail({}, {"scene"})
    assert capsys.readouterr().out.splitlines() == [NOT_FINISHED]
    log.write_text("12 pairs\nerror: It is full.\n")
    run.fail({}, {"scene"})
    failed = f"snakesfm: scene 'scene' failed: It is full. (log: {log})"
    assert capsys.readouterr().out.splitlines() == [failed]


@pytest.mark.parametrize(
    ("summary", "metrics", "said"),
    [
        ({}, {}, "5 of 9 images registered, 321 points, mean reprojection error 0.500 px, "),
        ({"images_in_other_models": [2, 1]}, {}, " registered and 3 in 2 other models, 321 points, "),
        ({}, {"reference_images": 7, "reference_images_present": 0}, " px, no image name occurs in the"),
        (
            {},
            {"reference_images": 7, "reference_images_present": 7, **METRICS},
            " px, relative-pose AUC 91.0/93.0/95.0 at 1/3/5 deg, ",
        ),
        (
            {},
            {"reference_images": 7, "reference_images_present": 6, **METRICS},
            " at 1/3/5 deg over the reference's 7 images, 6 of them here, ",
        ),
    ],
)
def test_the_last_line_says_what_there_is(
    run: Run, summary: dict, metrics: dict, said: str, capsys: pytest.CaptureFixture
) -> None:
    write("out/scene/export_model/summary.json", json.dumps({**SUMMARY, **summary, "warnings": ["Look."]}))
    write("out/scene/evaluate_model/metrics.json", json.dumps(metrics))
    capsys.readouterr()
    run.finish({"scene": MODEL})
    line, warning = capsys.readouterr().out.splitlines()
    assert said in line
    assert line.endswith("model in out/scene/export_model/sparse/0")
    assert ("AUC" in line) == bool(metrics.get("reference_images_present"))
    assert ("other models" in line) == bool(summary)
    assert warning == "snakesfm: scene 'scene': warning: Look."
