"""Calls of Snakemake as forks of one process that has loaded it.

Loading it takes over a second of processor time, five times what a call does beside its jobs. Nothing else
is loaded before, so that each call reads the Snakefile, and imports snakesfm, as the command does.
"""

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["snakemake.cli"])


def call_snakemake(
    arguments: list[str], folder: Path, environment: Mapping[str, str], log: Path, timeout: float
) -> int:
    """Do as the command does in a folder, its output in a log, and give its exit status."""
    process = FORKS.Process(target=_become_snakemake, args=(arguments, folder, dict(environment), log))
    process.start()
    process.join(timeout)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise subprocess.TimeoutExpired(arguments, timeout, log.read_bytes())
    return process.exitcode


def _become_snakemake(arguments: list[str], folder: Path, environment: dict[str, str], log: Path) -> None:
    with log.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ["snakemake", *arguments]
    from snakemake.cli import main

    main()
