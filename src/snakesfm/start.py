"""Entry point of a job's script: a fork of the run's job server, or the job in this process.

Imports no more than it needs to ask the server, as this is what each job waits for.
"""

import os
import signal
import socket
import sys

from snakesfm.run_pipe import end_with_run

VARIABLE = "SNAKESFM_JOB_SERVER"
NO_SERVER = "off"


def start_job(stage: str) -> None:
    """Run one stage as the Snakemake job that standard input describes.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    """
    _open_standard_streams()
    status = fork_job(stage)
    if status is not None:
        sys.exit(status)
    end_with_run()
    from snakesfm.job import run_job

    run_job(stage)


def _open_standard_streams() -> None:
    """Open the null device as each standard stream that whoever started the run had closed.

    Otherwise the next file that is opened gets the number of the stream, and what is printed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # the lowest free number, which is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
        if number and getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", buffering=1, encoding="utf-8", closefd=False))


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
