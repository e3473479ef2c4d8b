"""Runs a command in processes of its own and measures time, processor time and memory."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from benchmarks import SOURCES

SAMPLE_S = 0.2
FOLDERS = re.compile(r"(?:/[^\s/]+)+/")
UNDISTURBED = 0.05


@dataclass(frozen=True)
class Cost:
    """What a command took.

    Attributes
    ----------
    seconds : wall clock.
    cpu_seconds : processor time, user and system, of all its processes.
    peak_mib : resident memory: the largest sampled sum over the processes that ran at the same time, or
        the high-water mark of one process, whichever is more; in the sum, pages that processes share count
        once.
    others : share of the machine's processor time that others used meanwhile, 0 to 1.
    """

    seconds: float
    cpu_seconds: float
    peak_mib: float
    others: float = 0.0

    @property
    def undisturbed(self) -> bool:
        """Whether the wall clock may be trusted."""
        return self.others <= UNDISTURBED

    def __add__(self, other: "Cost") -> "Cost":
        """One after the other."""
        return Cost(
            self.seconds + other.seconds,
            self.cpu_seconds + other.cpu_seconds,
            max(self.peak_mib, other.peak_mib),
            max(self.others, other.others),
        )


class CommandError(Exception):
    """A command that ended with an error or took too long: what it said last, and what it cost."""

    def __init__(self, reason: str, cost: Cost) -> None:
        super().__init__(reason)
        self.cost = cost


def run_measured(command: list[str], folder: Path, log: Path, limit_s: float) -> Cost:
    """Run a command in a session of its own; all its processes are killed at the limit.

    Raises
    ------
    CommandError : a non-zero status, a signal, or the limit was passed.
    """
    started, busy, peak, late = time.monotonic(), _busy_seconds(), 0.0, False
    with log.open("w", encoding="utf-8") as stream:
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, **SOURCES},
        )
        try:
            while True:
                peak = max(peak, _memory_mib(process.pid))
                done, status, usage = os.wait4(process.pid, os.WNOHANG)
                if done:
                    break
                if time.monotonic() - started > limit_s and not late:
                    late = True
                    os.killpg(process.pid, signal.SIGKILL)
                time.sleep(SAMPLE_S)
        except BaseException:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds, cpu_seconds = time.monotonic() - started, usage.ru_utime + usage.ru_stime
    others = (_busy_seconds() - busy - cpu_seconds) / (seconds * (os.cpu_count() or 1))
    cost = Cost(
        round(seconds, 2),
        round(cpu_seconds, 2),
        round(peak, 1),
        round(min(max(others, 0.0), 1.0), 3),
    )
    if late:
        raise CommandError(f"stopped at the limit of {limit_s:.0f} s", cost)
    if process.returncode < 0:
        raise CommandError(f"crashed by {signal.Signals(-process.returncode).name}", cost)
    if process.returncode:
        lines = [line.strip() for line in log.read_text("utf-8", errors="replace").splitlines()]
        said = next((line for line in reversed(lines) if line), "no message")
        # Snakemake goes on after the workflow's own sentence
        own = (line.partition(" failed: ")[2] for line in lines if line.startswith("snakesfm: scene "))
        said = next((sentence for sentence in own if sentence), said)
        raise CommandError(f"failed: {FOLDERS.sub('', said)[:200]}", cost)
    return cost


def run_operation(operation: str, arguments: dict[str, Any], log: Path, limit_s: float) -> Cost:
    """Run an operation of ``peers`` in a process of its own.

    Raises
    ------
    CommandError : as :func:`run_measured`.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".json", encoding="utf-8") as file:
        json.dump({"operation": operation, "arguments": arguments}, file)
        file.flush()
        command = [sys.executable, "-m", "benchmarks.compare.peers", file.name]
        return run_measured(command, log.parent, log, limit_s)


def _memory_mib(pid: int) -> float:
    """Memory of a process and all below it, or the largest high-water mark of one, in MiB.

    The system's own record (ru_maxrss) will not do: it holds what the process that started them used.
    """
    total, highest = 0, 0
    with contextlib.suppress(psutil.Error):
        top = psutil.Process(pid)
        for process in (top, *top.children(recursive=True)):
            with contextlib.suppress(psutil.Error, OSError):
                # pages that several processes share count once
                total += process.memory_full_info().pss
                status = Path(f"/proc/{process.pid}/status").read_text("utf-8")
                marks = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
                highest = max([highest, *(1024 * int(mark) for mark in marks)])
    return max(total, highest) / 2**20


def _busy_seconds() -> float:
    """Processor time that the machine has spent on anything since it started."""
    times = psutil.cpu_times()
    return float(times.user + times.nice + times.system)
