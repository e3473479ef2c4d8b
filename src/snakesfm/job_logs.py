"""The last line of a job's log, which says what the job cost or why it failed."""

import re
import time
from collections.abc import Iterable
from pathlib import Path

DONE = re.compile(
    r"^(?P<clock>\d{4}-\d\d-\d\dT\S+) (?P<stage>\w+) done in (?P<seconds>[\d.]+) s, "
    r"(?P<cpu>[\d.]+) s of processor time, (?P<mb>\d+) MB at most$",
    re.MULTILINE,
)

KILLED = "was killed from outside (out of memory, time limit, cancelled, or its node failed)"
# what SQLite says before it ends a process in which COLMAP writes a database
FULL_SIGN = "database or disk is full"
LACKS_SPACE = "ended as the disk is full: free the disk, then run again"


def describe_cost(stage: str, ended: float, seconds: float, cpu_seconds: float, peak_mb: float) -> str:
    """The line that ``DONE`` finds.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    ended : seconds since the epoch.
    seconds, cpu_seconds, peak_mb : wall clock, processor time and the largest memory.
    """
    return (
        f"{clock(ended)} {stage} done in {seconds:.2f} s, "
        f"{cpu_seconds:.2f} s of processor time, {peak_mb:.0f} MB at most"
    )


def clock(seconds: float) -> str:
    """Local date and time to the millisecond."""
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.localtime(seconds)) + f".{int(seconds % 1 * 1000):03d}"


def find_cost(text: str) -> re.Match[str] | None:
    """What ``DONE`` finds in a job's log, of the last run of several; None where none ended."""
    found = None
    for found in DONE.finditer(text):  # noqa: B007
        pass
    return found


def stage_costs(logs: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Seconds (sum over jobs) and peak memory in MB (largest job) of each stage.

    Parameters
    ----------
    logs : the text of each job's log; a job that was run again counts with its last run.
    """
    costs: dict[str, tuple[float, float]] = {}
    for text in logs:
        found = find_cost(text)
        if found:
            sum_s, most_mb = costs.get(found["stage"], (0.0, 0.0))
            costs[found["stage"]] = sum_s + float(found["seconds"]), max(most_mb, float(found["mb"]))
    return costs


def describe_failures(folder: Path, since: float, interrupted: bool) -> list[str]:
    """The sentences of jobs that failed, with their logs.

    Parameters
    ----------
    folder : where the logs are, in folders of their stages.
    since : logs of before are left out; seconds on the clock of the file system.
    interrupted : jobs that were killed are left out, as the user's interrupt of the run kills them.
    """
    sentences = []
    for log in sorted(folder.rglob("*.log")):
        if log.stat().st_mtime < since:
            continue
        lines = log.read_text("utf-8", errors="replace").splitlines()
        # one that is killed before its first line leaves an empty log
        if lines and lines[-1].startswith("error: "):
            sentences.append(f"{lines[-1].removeprefix('error: ')} (log: {log})")
        elif not interrupted and (not lines or not find_cost(lines[-1])):
            full = any(FULL_SIGN in line for line in lines)
            reason = LACKS_SPACE if full else KILLED
            sentences.append(f"{log.parent.name} {log.stem} {reason} (log: {log})")
    return sentences
