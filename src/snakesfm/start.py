"""What a job's script calls: a fork of the run's job server, or the job in this process.

Imports no more than it needs to ask the server, as this is what each job waits for.
"""

import contextlib
import fcntl
import os
import signal
import socket
import sys

VARIABLE = "SNAKESFM_JOB_SERVER"
NO_SERVER = "off"
RUN_PIPE = "run"
"""Beside the server's socket: a pipe that the run holds open, so that it ends when the run does."""


def start_job(stage: str) -> None:
    """Run one stage as the Snakemake job that standard input describes.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    """
    status = fork_job(stage)
    if status is not None:
        sys.exit(status)
    end_with_run()
    from snakesfm.job import run_job

    run_job(stage)


def end_with_run() -> None:
    """Have the system end this process, by SIGIO, when the run that it belongs to is gone.

    A job that outlives its run would write over what the next run makes.
    """
    address = os.environ.get(VARIABLE, NO_SERVER)
    if address == NO_SERVER:
        return
    with contextlib.suppress(OSError):
        end_with(os.open(f"{address.rpartition('/')[0]}/{RUN_PIPE}", os.O_RDONLY | os.O_NONBLOCK))


def end_with(file: int) -> None:
    """Have the system end this process, by SIGIO, when nobody holds the other end of a pipe or socket."""
    fcntl.fcntl(file, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(file, fcntl.F_SETFL, fcntl.fcntl(file, fcntl.F_GETFL) | os.O_ASYNC | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        # there may have been nobody before
        if not os.read(file, 1):
            os._exit(1)


def fork_job(stage: str) -> int | None:
    """Have the server fork a job with this process's standard streams and environment, and wait for it.

    Parameters
    ----------
    stage : verb_noun name of the stage.

    Returns
    -------
    The job's exit status; None where there is no server, so that nothing was done.
    """
    address = os.environ.get(VARIABLE, NO_SERVER)
    if address == NO_SERVER:
        return None
    request = b"\0".join([stage.encode(), *(b"%s=%s" % item for item in os.environb.items())])
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        try:
            server.connect(address)
            socket.send_fds(server, [request], [0, 1, 2])
        except OSError:
            return None
        # an interrupt from the terminal reaches the job too, which ends by it and says so
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            # a job that is killed says nothing
            return int(server.recv(16) or b"1")
        except OSError:
            return 1
