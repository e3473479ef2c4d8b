"""The last line of a job's log, which says what the job cost."""

import re
import time
from collections.abc import Iterable

DONE = re.compile(
    r"^(?P<clock>\d{4}-\d\d-\d\dT\S+) (?P<stage>\w+) done in (?P<seconds>[\d.]+) s, "
    r"(?P<cpu>[\d.]+) s of processor time, (?P<mb>\d+) MB at most$",
    re.MULTILINE,
)


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
