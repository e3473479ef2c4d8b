"""The SLURM jobs of an earlier run: they live on when the run that submitted them was killed."""

import subprocess
import sys
import time
from typing import Any

from snakesfm.errors import ConfigError

LONGEST_WAIT_S = 300


def steady(executor: Any) -> None:
    """Have Snakemake's SLURM plugin (2.8) ask for its jobs at a steady pace, and go on while SLURM is down.

    By itself it lets 10 s more pass after each answer in which no job had ended, so that a job of one
    minute is noticed half a minute late. And it asks before each query how long SLURM remembers jobs; where
    slurmctld does not answer, it takes ``sacct`` for all attempts of that query, and without accounting it
    has then lost its jobs.

    Parameters
    ----------
    executor : the plugin's, with jobs or without; its queries are as far apart as Snakemake's option
        ``seconds-between-status-checks`` says, at most.
    """
    kind = type(executor)
    longest = executor.workflow.remote_execution_settings.seconds_between_status_checks

    def seconds(self: Any) -> float:
        chosen: float = kind.next_seconds_between_status_checks.fget(self)
        return float(min(chosen, longest))

    pace = property(seconds, kind.next_seconds_between_status_checks.fset)
    executor.__class__ = type(kind.__name__, (kind,), {"next_seconds_between_status_checks": pace})
    plugin: Any = sys.modules[kind.__module__]
    age = plugin.get_min_job_age()
    if age is not None:
        plugin.get_min_job_age = lambda: age


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
            f"SLURM jobs of an interrupted run may still write to '{output}' and cannot be ended from "
            f"here: type 'scancel --name={run}' where SLURM answers, delete {lock}, and run again."
        )
    return len(jobs)
