"""What the executor of SLURM jobs does about those that neither run nor end, and how often it asks."""

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
        self.workflow = SimpleNamespace(
            remote_execution_settings=SimpleNamespace(seconds_between_status_checks=5),
            executor_settings=SimpleNamespace(no_requeue=True),
        )
        self.run_uuid = "run"
        self.logger = logging.getLogger("test")
        self.succeeded: list[str] = []
        self.failed: list[str] = []

    def report_job_success(self, job) -> None:
        self.succeeded.append(job.external_jobid)

    def report_job_error(self, job, msg="", aux_logs=()) -> None:
        self.failed.append(f"{msg}{aux_logs}")

    async def check_active_jobs(self, active_jobs):
        states, _ = await query_job_status("squeue", self.logger)
        for job in active_jobs if states is not None else []:
            if states.get(job.external_jobid) == "COMPLETED":
                self.report_job_success(job)
            elif states.get(job.external_jobid) == "CANCELLED":
                self.report_job_error(job, msg="cancelled")
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
    rules = {"7": {"build_tracks", "adjust_bundle"}, "8": ["match_pairs"], "9": ["match_pairs"]}
    jobs = {
        number: SimpleNamespace(
            external_jobid=number, aux={"slurm_logfile": "a.log"}, job=SimpleNamespace(rules=names)
        )
        for number, names in rules.items()
    }
    active = [jobs["7"], jobs["8"]]

    def ask(answer, seconds=QUIET_S):
        nonlocal active
        said[0] = answer

        async def check():
            return [job async for job in executor.check_active_jobs(active)]

        active = asyncio.run(check())
        now[0] += seconds
        return [job.external_jobid for job in active], list(executor.succeeded)

    ask.executor = executor
    ask.submit = lambda: active.append(jobs["9"])
    return ask


def test_a_job_that_accounting_says_more_of_has_ended(slurm_answers):
    assert slurm_answers({"7": "CANCELLED by 1000", "8": "RUNNING"}) == (["8"], [])
    assert slurm_answers.executor.failed == ["cancelled()"]


@pytest.mark.parametrize("no_requeue", [True, False])
def test_a_job_that_was_preempted_is_over_unless_slurm_starts_it_again(slurm_answers, no_requeue):
    executor = slurm_answers.executor
    executor.workflow.executor_settings.no_requeue = no_requeue
    left = [slurm_answers({"7": "PREEMPTED", "8": "RUNNING"})[0] for _ in range(2)]
    assert left == [["8"] if no_requeue else ["7", "8"]] * 2
    assert executor.failed == (["SLURM-job '7' was preempted. ['a.log']"] if no_requeue else [])
    # the plugin has a warning that SLURM resumes such jobs, once
    assert executor._preemption_warning


def test_a_job_that_slurm_will_not_start_is_named_once_per_reason(slurm_answers, monkeypatch, caplog):
    asked = []

    def reasons(run):
        asked.append(run)
        return {"7": "PartitionTimeLimit" if len(asked) > 1 else "Priority", "8": "Resources"}

    monkeypatch.setattr(slurm, "pending_reasons", reasons)
    for _ in range(4):
        slurm_answers({"7": "RUNNING", "8": "RUNNING"})
    assert asked == [], "no job is pending"
    minutes = 20
    for _ in range(2 * minutes):
        slurm_answers({"7": "PENDING", "8": "PENDING"})
    assert 0.2 * minutes < len(asked) < 0.5 * minutes
    (warning,) = caplog.messages
    assert "job 7 (adjust_bundle, build_tracks): PartitionTimeLimit." in warning
    assert "set-resources" in warning


@pytest.mark.parametrize(
    ("reason", "hopeless"),
    [
        *((reason, True) for reason in ("PartitionNodeLimit", "BadConstraints", "AccountNotAllowed")),
        *(
            (reason, True)
            for reason in ("QOSMaxWallDurationPerJobLimit", "AssocMaxMemPerJob", "QOSMinMemory")
        ),
        *((reason, True) for reason in ("AssocGrpCPUMinutesLimit", "QOSGrpWallLimit", "MaxMemPerLimit")),
        # other jobs end, a dependency is made, an administrator lets it go
        *((reason, False) for reason in ("Resources", "Priority", "None", "Dependency", "JobHeldAdmin")),
        *((reason, False) for reason in ("QOSMaxJobsPerUserLimit", "AssocGrpCpuLimit", "PartitionDown")),
        *(
            (reason, False)
            for reason in ("AssocGrpCPURunMinutesLimit", "ReqNodeNotAvail, UnavailableNodes:n1")
        ),
    ],
)
def test_reasons_that_pass_by_themselves_are_told_from_others(reason, hopeless):
    assert bool(slurm.HOPELESS.fullmatch(reason)) == hopeless


def test_slurm_is_asked_why_jobs_are_pending(tmp_path, monkeypatch):
    program = tmp_path / "squeue"
    program.write_text(
        '#!/bin/sh\necho "$@" > asked\nprintf "7|Priority\\n8|ReqNodeNotAvail, Unavailable:n1\\n"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert slurm.pending_reasons("a-b") == {"7": "Priority", "8": "ReqNodeNotAvail, Unavailable:n1"}
    assert (tmp_path / "asked").read_text() == "--noheader --format=%i|%r --name=a-b --states=PENDING\n"


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


def test_jobs_are_asked_for_less_often_the_longer_none_ends(slurm_answers):
    executor = slurm_answers.executor

    def pauses(count, states):
        return [(slurm_answers(states), executor.pause())[1] for _ in range(count)]

    running = {"7": "RUNNING", "8": "RUNNING"}
    # answers are 30 s apart, and a twentieth of 100 s is 5 s
    assert pauses(3, running) == [5, 5, 5]
    assert pauses(2, running) == pytest.approx([6, 7.5])
    assert pauses(60, running)[-1] == 60
    slurm_answers.submit()
    assert pauses(1, {**running, "9": "PENDING"}) == [5]
    assert pauses(60, {**running, "9": "RUNNING"})[-1] == 60
    assert pauses(1, {"7": "COMPLETED", "8": "RUNNING", "9": "RUNNING"}) == [5]
    executor.workflow.remote_execution_settings.seconds_between_status_checks = 90
    assert executor.pause() == 90


@pytest.mark.parametrize(("age", "longest"), [(300, 60), (60, 20), (None, 60), (0, 60)])
def test_a_job_that_ended_is_asked_for_before_slurm_forgets_it(monkeypatch, age, longest):
    module = sys.modules[__name__]
    monkeypatch.setattr(module, "get_min_job_age", lambda: age)
    monkeypatch.setattr(module, "query_job_status", query_job_status)
    executor = Plugin()
    slurm.steady(executor)
    executor.changed -= 10_000
    assert executor.pause() == longest


@pytest.mark.parametrize("wait", [True, False])
def test_a_run_that_ends_waits_for_no_query(monkeypatch, wait):
    now, module = [0.0], sys.modules[__name__]

    async def pass_time(seconds):
        now[0] += seconds

    monkeypatch.setattr(module, "query_job_status", query_job_status)
    monkeypatch.setattr(slurm.time, "monotonic", lambda: now[0])
    executor = Plugin()
    slurm.steady(executor)
    executor.wait = wait
    monkeypatch.setattr(slurm.asyncio, "sleep", pass_time)
    asyncio.run(executor.sleep())
    assert now == [5.0 if wait else 0.0]
