"""What the executor of SLURM jobs does about those whose state it does not learn."""

import asyncio
import logging
import sys
from types import SimpleNamespace

import pytest

from snakesfm import slurm

QUIET_S = 30.0


class Plugin:
    """As Snakemake's plugin is where it matters: what it asks, and what it does with the answer."""

    def __init__(self) -> None:
        settings = SimpleNamespace(seconds_between_status_checks=5)
        self.workflow = SimpleNamespace(remote_execution_settings=settings)
        self.run_uuid = "run"
        self.logger = logging.getLogger("test")
        self.chosen = 40.0
        self.succeeded: list[str] = []

    @property
    def next_seconds_between_status_checks(self) -> float:
        return self.chosen

    @next_seconds_between_status_checks.setter
    def next_seconds_between_status_checks(self, seconds: float) -> None:
        self.chosen = seconds

    def report_job_success(self, job) -> None:
        self.succeeded.append(job.external_jobid)

    async def check_active_jobs(self, active_jobs):
        states, _ = await query_job_status("squeue", self.logger)
        for job in active_jobs if states is not None else []:
            if states.get(job.external_jobid) == "COMPLETED":
                self.report_job_success(job)
            else:
                yield job


def get_min_job_age() -> int:
    return 300


async def query_job_status(command, logger):
    raise NotImplementedError


@pytest.fixture
def slurm_answers(monkeypatch):
    """A function that has SLURM answer and time pass: which jobs are still active, and which succeeded."""
    now, said = [0.0], [{}]

    async def answer(command, logger):
        return said[0], 0.1

    module = sys.modules[__name__]
    monkeypatch.setattr(module, "query_job_status", answer)
    # whatever is put into its place later is taken away again
    monkeypatch.setattr(module, "get_min_job_age", get_min_job_age)
    monkeypatch.setattr(slurm.time, "monotonic", lambda: now[0])
    executor = Plugin()
    slurm.steady(executor)
    active = [SimpleNamespace(external_jobid=number) for number in ("7", "8")]

    def ask(answer):
        nonlocal active
        said[0] = answer

        async def check():
            return [job async for job in executor.check_active_jobs(active)]

        active = asyncio.run(check())
        now[0] += QUIET_S
        return [job.external_jobid for job in active], list(executor.succeeded)

    ask.executor = executor
    return ask


def test_jobs_are_kept_while_slurm_does_not_answer(slurm_answers):
    for _ in range(10):
        assert slurm_answers(None) == (["7", "8"], [])
    assert slurm_answers({"7": "COMPLETED", "8": "RUNNING"}) == (["8"], ["7"])


def test_a_job_that_slurm_forgot_is_looked_for_after_a_while(slurm_answers, monkeypatch):
    known = ["7"]
    monkeypatch.setattr(slurm, "list_jobs", lambda run: known)
    answers = [slurm_answers({"8": "RUNNING"}) for _ in range(4)]
    assert answers == [(["7", "8"], [])] * 4, "squeue still lists it"
    known.clear()
    assert slurm_answers({"7": "RUNNING", "8": "RUNNING"}) == (["7", "8"], []), "it is there again"
    answers = [slurm_answers({"8": "RUNNING"}) for _ in range(3)]
    assert answers == [(["7", "8"], [])] * 2 + [(["8"], ["7"])]


def test_a_job_is_kept_while_nobody_can_say_whether_it_is_there(slurm_answers, monkeypatch):
    def fail(run):
        raise slurm.subprocess.TimeoutExpired("squeue", 60)

    monkeypatch.setattr(slurm, "list_jobs", fail)
    assert [slurm_answers({"8": "RUNNING"}) for _ in range(4)] == [(["7", "8"], [])] * 4


@pytest.mark.parametrize(("known", "later"), [(300, 300), (None, 120)])
def test_how_long_slurm_remembers_jobs_is_asked_until_it_is_known(monkeypatch, known, later):
    module, ages = sys.modules[__name__], [known, 120]
    monkeypatch.setattr(module, "get_min_job_age", lambda: ages.pop(0))
    monkeypatch.setattr(module, "query_job_status", query_job_status)
    slurm.steady(Plugin())
    assert module.get_min_job_age() == later


def test_jobs_are_asked_for_at_a_steady_pace(slurm_answers):
    executor = slurm_answers.executor
    assert executor.next_seconds_between_status_checks == 5
    executor.next_seconds_between_status_checks = 2
    assert executor.next_seconds_between_status_checks == 2
    assert executor.chosen == 2
