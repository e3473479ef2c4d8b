"""What a run says of its results in the end, where it was ended before or was to make others."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from workflow_runner import Workflow, config_of, copy_run, model_bytes

from snakesfm.job_logs import describe_failures
from snakesfm.start import NO_SERVER, VARIABLE

pytestmark = pytest.mark.workflow

# Snakemake, which gets TERM from itself while it deals with a job that has ended
TERM_IN_TIME = """
import os, signal
from snakemake.cli import main
from snakemake.scheduling.job_scheduler import JobScheduler

finish_jobs = JobScheduler._finish_jobs

def finish_and_terminate(scheduler):
    finish_jobs(scheduler)
    if scheduler.finished_jobs:
        os.kill(os.getpid(), signal.SIGTERM)

JobScheduler._finish_jobs = finish_and_terminate
main()
"""


def test_a_controller_that_gets_term_while_it_deals_with_ended_jobs_ends(
    finished, small_scene: Path, workflow: Workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    script = workflow.folder / "snakemake_with_term.py"
    script.write_text(TERM_IN_TIME)
    arguments = workflow.command(*config_of(small_scene, "match_pairs={max_ratio: 0.75}"))
    assert arguments[1:3] == ["-m", "snakemake"]
    ended = subprocess.run(
        [sys.executable, str(script), *arguments[3:]],
        cwd=workflow.folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 1, ended.stdout
    assert "rule match_pairs" in ended.stdout and "rule adjust_bundle" not in ended.stdout
    lines = [line for line in ended.stdout.splitlines() if line.startswith("snakesfm: scene")]
    # all results of the former options are still there
    assert lines[-1].startswith("snakesfm: scene 'square' is not finished: start the same command again; ")
    again = workflow.run(*config_of(small_scene))
    assert again.status == 0, again.text
    assert "16 of 16 images registered" in again.summary[-1]
    assert model_bytes(workflow.folder / "out" / "square") == model_bytes(finished[0])


def test_a_run_that_the_user_interrupts_says_how_to_go_on_and_names_no_failure(
    finished, small_scene: Path, workflow: Workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    log = workflow.folder / "out" / "square" / "logs" / "extract_features" / "0.log"
    log.unlink()
    run = workflow.start(*config_of(small_scene, "extract_features={max_keypoints: 4000}"))
    limit = time.monotonic() + 120
    while not (log.is_file() and log.stat().st_size) and run.poll() is None and time.monotonic() < limit:
        time.sleep(0.01)
    # as the terminal does on Ctrl-C
    os.killpg(run.pid, signal.SIGINT)
    text, _ = run.communicate(timeout=120)
    assert run.returncode == 1, text
    lines = [line for line in text.splitlines() if line.startswith("snakesfm: scene")]
    assert lines[-1] == "snakesfm: scene 'square' is not finished: start the same command again."
    assert "killed from outside" not in text


@pytest.mark.parametrize("closed", ["1", "2"])
@pytest.mark.parametrize("server", ["", NO_SERVER])
def test_a_run_without_a_standard_stream_ends_well_and_has_its_logs(
    finished, small_scene: Path, workflow: Workflow, closed: str, server: str
) -> None:
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    (output / "evaluate_model" / "metrics.json").unlink()
    log = output / "logs" / "evaluate_model" / "job.log"
    before = log.read_text()
    command = workflow.command(*config_of(small_scene))
    environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
    environment |= {VARIABLE: server} if server else {}
    ended = subprocess.run(
        ["bash", "-c", f'"$@" {closed}>&-', "bash", *command],
        cwd=workflow.folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0 and "Traceback" not in ended.stdout, ended.stdout
    assert (output / "evaluate_model" / "metrics.json").is_file()
    lines = log.read_text().splitlines()
    assert lines != before.splitlines()
    assert [lines[place].split()[1] for place in (0, -1)] == ["evaluate_model"] * 2


def test_a_job_that_was_killed_before_its_first_line_is_named(finished, workflow: Workflow) -> None:
    copy_run(finished[0], workflow.folder)
    logs, now = workflow.folder / "out" / "square" / "logs", time.time()
    assert describe_failures(logs, now, False) == []
    log = logs / "match_pairs" / "0-0.log"
    log.write_bytes(b"")
    os.utime(log, (now + 1, now + 1))
    (sentence,) = describe_failures(logs, now, False)
    assert sentence.startswith("match_pairs 0-0 was killed from outside") and str(log) in sentence


@pytest.mark.parametrize(
    ("target", "option", "rules"),
    [
        (["--until", "match_pairs"], "match_pairs={max_ratio: 0.75}", {"match_pairs"}),
        # no file that the model is made from is newer than it
        (["databases"], "adjust_bundle={max_iterations: 77}", {"export_database", "databases"}),
    ],
)
def test_a_model_of_former_options_is_not_called_this_run_s(
    finished, small_scene: Path, workflow: Workflow, target: list[str], option: str, rules: set[str]
) -> None:
    copy_run(finished[0], workflow.folder)
    outcome = workflow.run(*target, *config_of(small_scene, option))
    assert outcome.status == 0, outcome.text
    assert set(outcome.rules) == rules
    *_, line = outcome.summary
    assert "the model is older than its images or options: 'all' updates it" in line
    assert "registered" not in line
    assert ("COLMAP database in out/square/export_database/database.db" in line) == (
        target == ["databases"]
    )


def test_a_model_of_these_options_is_named_beside_the_database(
    finished, small_scene: Path, workflow: Workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    outcome = workflow.run("databases", *config_of(small_scene))
    assert outcome.status == 0, outcome.text
    *_, line = outcome.summary
    assert "16 of 16 images registered" in line and "relative-pose AUC" in line
    assert line.endswith(
        "model in out/square/export_model/sparse/0, "
        "COLMAP database in out/square/export_database/database.db"
    )
    # the database was not asked for, so nobody has looked whether it is of these options
    other = workflow.run("--until", "export_model", *config_of(small_scene, "build_tracks={min_length: 4}"))
    assert other.status == 0, other.text
    *_, line = other.summary
    assert "images registered" in line
    # metrics are of the former model
    assert "database" not in line and "relative-pose AUC" not in line


def test_rule_select_pairs_is_known_by_its_name_where_scenes_differ_in_blocks(
    small_scene: Path, workflow: Workflow
) -> None:
    images = sorted((small_scene / "images").iterdir())
    for scene, count in (("few", 16), ("many", 70), ("others", 10)):
        (workflow.folder / scene).mkdir()
        for number in range(count):
            (workflow.folder / scene / f"{number:02d}.jpg").symlink_to(images[number % 16])
    scenes = ", ".join(f"{name}: {{images: {name}}}" for name in ("few", "many", "others"))
    arguments = ["--dry-run", "--config", f"scenes={{{scenes}}}", "output=out"]
    resources = ["--set-resources", "select_pairs:mem_mb=1234", "--set-threads", "select_pairs=1"]
    outcome = workflow.run(*arguments, *resources)
    assert outcome.status == 0, outcome.text
    assert outcome.rules.count("select_pairs") == 2
    assert outcome.rules.count("select_pairs_4_blocks") == 1
    assert len(re.findall(r"^ +resources: .*mem_mb=1234", outcome.text, re.M)) == 3
    some = workflow.run(*arguments, "--until", "select_pairs")
    assert some.status != 0 and "'select_pairs select_pairs_4_blocks'" in some.text
    assert "Traceback" not in some.text
    until = workflow.run(*arguments, "--until", "select_pairs", "select_pairs_4_blocks")
    assert until.status == 0, until.text
    assert until.rules.count("select_pairs") == 2 and "match_pairs" not in until.rules
