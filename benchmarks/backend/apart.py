"""A method in a process of its own, with limits on time and memory, and what it needed."""

import importlib
import multiprocessing
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snakesfm.arrays import Array

MEMORY_BYTES = 8 << 30
LIBRARIES = ("gtsam", "pycolmap", "scipy.sparse.linalg", "scipy.sparse.csgraph", "scipy.spatial")


@dataclass(frozen=True)
class Outcome:
    """What a method returned and needed, or why it did not end.

    Parameters
    ----------
    value : what it returned; empty after a failure.
    cpu_s : processor seconds of all its threads.
    peak_mib : its largest resident memory above what the process began with.
    failure : one line, empty if there was none.
    """

    value: Array
    cpu_s: float = 0.0
    peak_mib: float = 0.0
    failure: str = ""


def import_libraries() -> None:
    """Import what methods import, so that neither the time nor the memory for it is counted as theirs."""
    for name in LIBRARIES:
        importlib.import_module(name)


def run_apart(method: Callable[[], Array], timeout_s: float) -> Outcome:
    """Call ``method`` in a forked process."""
    context = multiprocessing.get_context("fork")
    receiving, sending = context.Pipe(duplex=False)
    child = context.Process(target=_run, args=(method, sending))
    child.start()
    sending.close()
    nothing = np.zeros(0)
    try:
        if receiving.poll(timeout_s):
            return receiving.recv()
        child.kill()
        return Outcome(nothing, failure=f"not done in {timeout_s:.0f} s")
    except EOFError:
        child.join()
        return Outcome(nothing, failure=f"ended with exit code {child.exitcode}")
    finally:
        child.join()


def _run(method: Callable[[], Array], sending: Any) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    start = time.process_time()
    try:
        value = method()
    except Exception as fault:
        sending.send(Outcome(np.zeros(0), failure=f"{type(fault).__name__}: {fault}"[:200]))
        return
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - resident / 2**20
    sending.send(Outcome(value, seconds, max(peak, 0.0)))
