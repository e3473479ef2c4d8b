"""A pipe that a run on one machine keeps open, so that its jobs end when the run ends.

A job that outlives its run would write over what the next run makes. Imports little, as every job waits
for it.
"""

import contextlib
import fcntl
import os

VARIABLE = "SNAKESFM_RUN_PIPE"


def hold_open(path: str) -> None:
    """Make a named pipe, tell the jobs of it, and hold the end that is written to until this process ends.

    Parameters
    ----------
    path : of the pipe, which is made.
    """
    os.mkfifo(path)
    # to open it for writing alone would wait for a reader
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    os.open(path, os.O_WRONLY)
    os.close(reader)
    os.environ[VARIABLE] = path


def end_with_run() -> None:
    """Have the system end this process, by SIGIO, when the run that it belongs to is gone."""
    path = os.environ.get(VARIABLE)
    if path:
        with contextlib.suppress(OSError):
            end_with(os.open(path, os.O_RDONLY | os.O_NONBLOCK))


def end_with(file: int) -> None:
    """Have the system end this process, by SIGIO, when nobody holds the other end of a pipe or socket."""
    fcntl.fcntl(file, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(file, fcntl.F_SETFL, fcntl.fcntl(file, fcntl.F_GETFL) | os.O_ASYNC | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        # there may have been nobody before
        if not os.read(file, 1):
            os._exit(1)
