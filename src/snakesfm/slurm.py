"""SLURM jobs: cancelling those left by a killed run, and handling those that SLURM has forgotten."""

import subprocess
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

from snakesfm.errors import ConfigError

LONGEST_WAIT_S = 300
# of answers that lack a job
FORGOTTEN_S = 60


def steady(executor: Any) -> None:
    """Have Snakemake's SLURM plugin (2.8) ask for its jobs at a steady pace, and lose none of them.

    By itself it lets 10 s more pass after each answer in which no job had ended, so that a job of one
    minute is noticed half a minute late. It asks before each query how long SLURM remembers jobs; where
    slurmctld does not answer, it takes ``sacct`` for all attempts of that query, and without accounting it
    has then lost its jobs. It loses them too after a query that failed at all attempts, and it waits for
    ever for a job that SLURM forgot, as a slurmctld that crashed forgets the newest ones.

    Parameters
    ----------
    executor : the plugin's, with jobs or without; its queries are as far apart as Snakemake's option
        ``seconds-between-status-checks`` says, at most.
    """
    plugin: Any = sys.modules[type(executor).__module__]
    executor.__class__ = _patient_kind(type(executor))
    executor.answer, executor.missing_since = None, {}
    age, ask = plugin.get_min_job_age(), plugin.query_job_status
    if age is not None:
        plugin.get_min_job_age = lambda: age

    async def remember(command: str, logger: Any) -> Any:
        found = await ask(command, logger)
        executor.answer = found[0]
        return found

    plugin.query_job_status = remember


def _patient_kind(kind: Any) -> Any:
    """A class below the plugin's.

    Of its objects ``answer`` is the last query's: states by job id, None where SLURM did not answer; and
    ``missing_since`` says since when, on the monotonic clock, answers lack a job.
    """

    class Patient(kind):  # type: ignore[misc]
        @property
        def next_seconds_between_status_checks(self) -> float:
            settings = self.workflow.remote_execution_settings
            longest = settings.seconds_between_status_checks
            return float(min(super().next_seconds_between_status_checks, longest))

        @next_seconds_between_status_checks.setter
        def next_seconds_between_status_checks(self, seconds: float) -> None:
            kind.next_seconds_between_status_checks.fset(self, seconds)

        async def check_active_jobs(self, active_jobs: list[Any]) -> AsyncIterator[Any]:
            parent: Any = super()
            unfinished = [job async for job in parent.check_active_jobs(active_jobs)]
            if self.answer is None:
                unfinished = active_jobs
            for job in unfinished:
                if not self.is_forgotten(job.external_jobid):
                    yield job
                    continue
                # Snakemake then looks for its output, and runs it again where that is missing
                self.logger.warning(f"SLURM no longer knows job {job.external_jobid}.")
                self.report_job_success(job)

        def is_forgotten(self, number: str) -> bool:
            """Whether SLURM has answered for some time as if there were no such job."""
            if self.answer is None or number in self.answer:
                self.missing_since.pop(number, None)
                return False
            since = self.missing_since.setdefault(number, time.monotonic())
            if time.monotonic() - since < FORGOTTEN_S:
                return False
            try:
                # accounting may lag behind
                return number not in list_jobs(self.run_uuid)
            except (OSError, subprocess.SubprocessError):
                return False

    return Patient


def list_jobs(run: str) -> list[str]:
    """The ids of a run's jobs that are not finished; a run is known by the name that its jobs have.

    Raises
    ------
    OSError, subprocess.SubprocessError : SLURM cannot be asked.
    """
    unfinished = "PENDING,RUNNING,SUSPENDED,COMPLETING,CONFIGURING,REQUEUED"
    command = ["squeue", "--noheader", "--format=%i", f"--name={run}", f"--states={unfinished}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.split()


def end_jobs(run: str, output: str, lock: str) -> int:
    """Cancel the jobs of an earlier run and wait until they are gone.

    Parameters
    ----------
    run : name of its jobs.
    output, lock : the output folder and the file that named the run, for the sentence of an error.

    Returns
    -------
    How many there were.

    Raises
    ------
    ConfigError : SLURM cannot be asked, or the jobs do not end.
    """
    try:
        jobs = list_jobs(run)
        if jobs:
            subprocess.run(["scancel", f"--name={run}"], capture_output=True, timeout=60, check=True)
        limit = time.monotonic() + LONGEST_WAIT_S
        while jobs and list_jobs(run) and time.monotonic() < limit:
            time.sleep(1)
        ended = not jobs or not list_jobs(run)
    except (OSError, subprocess.SubprocessError):
        ended = False
    if not ended:
        raise ConfigError(
            f"SLURM jobs of an interrupted run may still write to '{output}' and cannot be cancelled from "
            f"here: run 'scancel --name={run}' where SLURM answers, delete {lock}, and run again."
        )
    return len(jobs)
