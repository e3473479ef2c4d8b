"""SLURM jobs: asking for them, ending those of a killed run, and those that SLURM lost or never starts."""

import asyncio
import math
import re
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

from snakesfm.errors import ConfigError

LONGEST_WAIT_S = 300
# of answers that lack a job
FORGOTTEN_S = 60
# between two queries: a share of the time since the last job ended or was submitted
QUIET_SHARE, LONGEST_PAUSE_S = 0.05, 60
BETWEEN_REASONS_S = 180
# why SLURM leaves a job pending for ever: a limit that it exceeds by itself, or a share that is used up
HOPELESS = re.compile(
    r"Partition(Time|Node)Limit|QOSTimeLimit|MaxMemPerLimit|BadConstraints|(Account|QOS)NotAllowed|"
    r"Invalid(Account|QOS)|QOSMin\w+|"
    r"(Assoc|QOS)(Max\w+Per(Job|Node)(Limit)?|Grp(?!\w*Run)\w+Minutes(Limit)?|GrpWallLimit)"
)


def steady(executor: Any) -> None:
    """Have Snakemake's SLURM plugin (2.8) ask for its jobs at a fitting pace, and lose none of them.

    By itself it lets 10 s more pass after each answer in which no job had ended, so that a job of one
    minute is noticed half a minute late. It asks before each query how long SLURM remembers jobs; where
    slurmctld does not answer, it takes ``sacct`` for all attempts of that query, and without accounting it
    has then lost its jobs. It loses them too after a query that failed at all attempts, and it waits for
    ever for a job that SLURM forgot, as a slurmctld that crashed forgets the newest ones, for one that
    accounting calls 'CANCELLED by 1000', for one that was preempted for good, and for one that SLURM will
    not start.

    Parameters
    ----------
    executor : the plugin's, with jobs or without; its queries are as far apart as Snakemake's option
        ``seconds-between-status-checks`` says, at least.
    """
    kind = type(executor)
    plugin: Any = sys.modules[kind.__module__]
    executor.answer, executor.missing_since = None, {}
    executor.left, executor.changed = set(), time.monotonic()
    executor.asked_reasons, executor.named_reasons = -math.inf, set()
    # it says that SLURM goes on with preempted jobs
    executor._preemption_warning = executor.workflow.executor_settings.no_requeue
    age, ask = plugin.get_min_job_age(), plugin.query_job_status
    if age is not None:
        plugin.get_min_job_age = lambda: age
    # or SLURM forgets a job that ended before it is asked
    executor.longest_pause = min(LONGEST_PAUSE_S, age / 3) if age else LONGEST_PAUSE_S
    executor.__class__ = _patient_kind(kind)

    async def remember(command: str, logger: Any) -> Any:
        states, seconds = await ask(command, logger)
        if states is not None:
            states = {number: state.partition(" ")[0] for number, state in states.items()}
        executor.answer = states
        return states, seconds

    plugin.query_job_status = remember


def _patient_kind(kind: Any) -> Any:
    """A class below the plugin's.

    Of its objects ``answer`` is the last query's: states by job id, None where SLURM did not answer;
    ``missing_since`` says since when, on the monotonic clock, answers lack a job; ``left`` are those
    that had not ended, and ``changed`` is when one last ended or was submitted; ``asked_reasons`` is when
    SLURM was last asked why jobs are pending, and ``named_reasons`` what was said of that.
    """

    class Patient(kind):  # type: ignore[misc]
        left: set[str]
        changed: float
        asked_reasons: float

        async def sleep(self) -> None:
            """Wait until the next query, or the end of the run."""
            until = time.monotonic() + self.pause()
            while self.wait and time.monotonic() < until:
                await asyncio.sleep(0.5)

        def pause(self) -> float:
            """Seconds until the next query: whatever the plugin chooses."""
            shortest = self.workflow.remote_execution_settings.seconds_between_status_checks
            quiet = time.monotonic() - self.changed
            return float(max(shortest, min(QUIET_SHARE * quiet, self.longest_pause)))

        async def check_active_jobs(self, active_jobs: list[Any]) -> AsyncIterator[Any]:
            parent: Any = super()
            unfinished = [job async for job in parent.check_active_jobs(active_jobs)]
            if self.answer is None:
                unfinished = active_jobs
            left = [job for job in unfinished if not self.has_ended(job)]
            before, after = ({job.external_jobid for job in jobs} for jobs in (active_jobs, left))
            if not self.left == before == after:
                self.left, self.changed = after, time.monotonic()
            self.name_hopeless(left)
            for job in left:
                yield job

        def has_ended(self, job: Any) -> bool:
            """Whether a job that the plugin takes for unfinished is none; it is reported then."""
            number = job.external_jobid
            no_requeue = self.workflow.executor_settings.no_requeue
            if no_requeue and self.answer and self.answer.get(number) == "PREEMPTED":
                log = str(job.aux.get("slurm_logfile"))
                self.report_job_error(job, msg=f"SLURM-job '{number}' was preempted. ", aux_logs=[log])
                return True
            if self.is_forgotten(number):
                # Snakemake then looks for its output, and runs it again where that is missing
                self.logger.warning(f"SLURM no longer knows job {number}.")
                self.report_job_success(job)
                return True
            return False

        def name_hopeless(self, jobs: list[Any]) -> None:
            """Warn of pending jobs that SLURM will not start, once per reason."""
            pending = [job for job in jobs if (self.answer or {}).get(job.external_jobid) == "PENDING"]
            now = time.monotonic()
            if not pending or now - self.asked_reasons < BETWEEN_REASONS_S:
                return
            self.asked_reasons = now
            try:
                reasons = pending_reasons(self.run_uuid)
            except (OSError, subprocess.SubprocessError):
                return
            for job in pending:
                reason = reasons.get(job.external_jobid, "")
                if reason in self.named_reasons or not HOPELESS.fullmatch(reason):
                    continue
                self.named_reasons.add(reason)
                rules = ", ".join(sorted(job.job.rules))
                self.logger.warning(
                    f"SLURM does not start job {job.external_jobid} ({rules}): {reason}. Stop this run, "
                    "change in set-resources of the profile what these rules request (mem_mb, runtime) or "
                    "where they run (slurm_partition, slurm_account), and start it again."
                )

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
    return _queue(run, "%i", "PENDING,RUNNING,SUSPENDED,COMPLETING,CONFIGURING,REQUEUED")


def pending_reasons(run: str) -> dict[str, str]:
    """Why each pending job of a run is so, by its id; raises as :func:`list_jobs`."""
    rows = (line.partition("|") for line in _queue(run, "%i|%r", "PENDING"))
    return {number: reason for number, _, reason in rows}


def _queue(run: str, columns: str, states: str) -> list[str]:
    """A line for each of a run's jobs in these states."""
    command = ["squeue", "--noheader", f"--format={columns}", f"--name={run}", f"--states={states}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.splitlines()


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
