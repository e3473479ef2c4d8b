"""Jobs are forked from one process that has loaded what they need.

Loading numpy, h5py, scipy, OpenCV and pycolmap takes 0.15 to 0.3 s of a job, often more than its work. So a
run on one machine has this server beside it: the command of a job asks it for a fork of itself, hands over
its standard streams and environment, and waits (``snakesfm.start``). Where there is no server, or not yet,
the command loads the libraries itself.
"""

import contextlib
import importlib
import os
import pkgutil
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Mapping
from pathlib import Path

from snakesfm import stages
from snakesfm.job import limit_library_threads, run_job
from snakesfm.start import RUN_PIPE, VARIABLE, end_with, end_with_run

LARGEST_REQUEST = 1 << 20
# stages import these only where they need them
LIBRARIES = (
    "cv2",
    "poselib",
    "pycolmap",
    "scipy.optimize",
    "scipy.sparse.csgraph",
    "scipy.sparse.linalg",
)


class JobServer:
    """The server of one run, as the process of Snakemake sees it."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.pipe: int | None = None

    def start(self, variables: Mapping[str, str]) -> None:
        """Start the server and have the jobs of this process ask it.

        Does nothing where the environment already names a server, or ``off`` for none, and where there is
        no room for temporary files or another process.

        Parameters
        ----------
        variables : environment of the server, beside that of this process.
        """
        if VARIABLE in os.environ:
            return
        with contextlib.suppress(OSError):
            # a folder that nobody else can enter
            folder = Path(tempfile.mkdtemp(prefix="snakesfm-"))
            address = str(folder / "jobs")
            self.pipe = _hold_open(folder / RUN_PIPE)
            # this end of the pipe stays open until this process ends, however it ends
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", "snakesfm.job_server", address],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **variables},
            )
            os.environ[VARIABLE] = address

    def stop(self) -> None:
        """End the server, whose processor time and that of its jobs then counts as this process's."""
        if self.process is not None:
            self.process.communicate()


def _hold_open(path: Path) -> int:
    """Make a named pipe, and open the end that is written to."""
    os.mkfifo(path)
    # to open it for writing alone would wait for a reader
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(path, os.O_WRONLY)
    os.close(reader)
    return writer


def serve(address: str) -> None:
    """Load the libraries, then fork a job for each process that asks, until standard input ends.

    Parameters
    ----------
    address : path of the socket, in a folder of the run; both are removed in the end.
    """
    # an interrupt from the terminal is for the jobs, also for one that is just being forked
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        _load_libraries()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(address)
            listener.listen(64)
            while sys.stdin not in select.select([sys.stdin, listener], [], [])[0]:
                _forget_ended_jobs()
                connection, _ = listener.accept()
                with connection:
                    if os.fork() == 0:
                        listener.close()
                        _become_job(connection)
            _forget_ended_jobs()
    finally:
        shutil.rmtree(Path(address).parent, ignore_errors=True)
    # to take the libraries down would keep the run waiting for a tenth of a second
    os._exit(0)


def _load_libraries() -> None:
    """Import the stages and what most of them import."""
    limit_library_threads()
    for module in pkgutil.iter_modules(stages.__path__, f"{stages.__name__}."):
        importlib.import_module(module.name)
    for name in LIBRARIES:
        importlib.import_module(name)


def _forget_ended_jobs() -> None:
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


def _become_job(connection: socket.socket) -> None:
    """Run the job that the other end asks for as this process, which ends with it."""
    status = 1
    try:
        request, streams, _, _ = socket.recv_fds(connection, LARGEST_REQUEST, 3)
        end_with(connection.fileno())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        for target, stream in enumerate(streams):
            os.dup2(stream, target)
            os.close(stream)
        stage, *variables = request.split(b"\0")
        os.environb.clear()
        for variable in variables:
            name, _, value = variable.partition(b"=")
            os.environb[name] = value
        end_with_run()
        run_job(stage.decode())
        status = 0
    except KeyboardInterrupt:
        status = 130
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
            connection.send(str(status).encode())
        # nothing of the server is cleaned up by a fork of it
        os._exit(status)


if __name__ == "__main__":
    serve(sys.argv[1])
