"""What a run says of its results in the end, where it was ended before or was to make others."""

import subprocess
import sys
from pathlib import Path

import pytest
from workflow_runner import Workflow, copy_run, model_bytes

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


def config_of(scene: Path, *options: str) -> list[str]:
    folders = (f"images={scene / 'images'}", f"reference={scene / 'reference'}", "output=out")
    return ["--config", *folders, *options]


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
    assert lines
    again = workflow.run(*config_of(small_scene))
    assert again.status == 0, again.text
    assert "16 of 16 images registered" in again.summary[-1]
    assert model_bytes(workflow.folder / "out" / "square") == model_bytes(finished[0])
