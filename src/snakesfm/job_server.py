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

from snakesfm import run_pipe, stages
from snakesfm.job import limit_library_threads, run_job
from snakesfm.start import VARIABLE

LARGEST_REQUEST = 1 << 20
# bytes of a socket's address are 107 at most
LONGEST_FOLDER = 90
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
        self.folder: Path | None = None

    def start(self, variables: Mapping[str, str]) -> None:
        """Start the server and have the jobs of this process ask it, and end with this process.

        There is no server where the environment already names one, or ``off`` for none, and where there is
        no room for temporary files or another process.

        Parameters
        ----------
        variables : environment of the server, beside that of this process.
        """
        with contextlib.suppress(OSError):
            self.folder = _make_folder()
            run_pipe.hold_open(str(self.folder / "run"))
            if VARIABLE in os.environ:
                return
            address = str(self.folder / "jobs")
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
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


def _make_folder() -> Path:
    """A folder that nobody else can enter, whose name leaves room for that of a socket."""
    folder = Path(tempfile.mkdtemp(prefix="snakesfm-"))
    if len(os.fsencode(folder)) > LONGEST_FOLDER:
        folder.rmdir()
        folder = Path(tempfile.mkdtemp(prefix="snakesfm-", dir="/tmp"))
    return folder


def serve(address: str) -> None:
    """Load the libraries, then fork a job for each process that asks, until standard input ends.

    Parameters
    ----------
    address : path of the socket, in a folder of the run; both are removed in the end.
    """
    # an interrupt from the terminal is for the jobs, also for one that is just being forked
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
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
    # the run does it, too, but not where it was killed
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
        run_pipe.end_with(connection.fileno())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        for target, stream in enumerate(streams):
            os.dup2(stream, target)
            os.close(stream)
        stage, *variables = request.split(b"\0")
        os.environb.clear()
        for variable in variables:
            name, _, value = variable.partition(b"=")
            os.environb[name] = value
        run_pipe.end_with_run()
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
