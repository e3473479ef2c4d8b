"""Jobs that are forked from a server behave as jobs of their own."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from snakesfm import run_pipe
from snakesfm.job import THREAD_VARIABLES
from snakesfm.job_server import JobServer
from snakesfm.start import NO_SERVER, VARIABLE

Command = subprocess.Popen[str]
CLIENT = "import sys; from snakesfm.start import fork_job; sys.exit(fork_job(sys.argv[1]) or 0)"
PARENT = """
import os, sys
from snakesfm.job_server import JobServer
server = JobServer()
server.start({})
print(os.environ["SNAKESFM_JOB_SERVER"], flush=True)
sys.stdin.read()
"""


def wait_until(condition: Callable[[], object], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.fixture
def parent(tmp_path: Path) -> Iterator[Command]:
    """A process that has started a server; its ``address`` is ready."""
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    for variable in (VARIABLE, *THREAD_VARIABLES):
        environment.pop(variable, None)
    process = subprocess.Popen(
        [sys.executable, "-c", PARENT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    yield process
    process.kill()
    process.communicate()


@pytest.fixture
def address(parent: Command) -> str:
    """The socket of a server that has loaded its libraries."""
    path = parent.stdout.readline().strip()
    wait_until(lambda: Path(path).exists())
    return path


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def server_of(parent: Command) -> int:
    (server,) = children(parent.pid)
    return server


def test_libraries_that_the_server_has_loaded_start_no_threads(address: str, parent: Command) -> None:
    tasks = Path(f"/proc/{server_of(parent)}/task")
    assert len(list(tasks.iterdir())) == 1


@pytest.fixture
def ask(address: str) -> Iterator[Callable[[str], Command]]:
    """Starts a job's command that has the server run a stage."""
    commands = []

    def start(stage: str) -> Command:
        commands.append(
            subprocess.Popen(
                [sys.executable, "-c", CLIENT, stage],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={
                    **os.environ,
                    VARIABLE: address,
                    run_pipe.VARIABLE: str(Path(address).parent / "run"),
                },
            )
        )
        return commands[-1]

    yield start
    for command in commands:
        command.kill()
        command.communicate()


def waiting_job(parent: Command, ask: Callable[[str], Command]) -> tuple[Command, int]:
    """A job that waits for its standard input, and its process."""
    command = ask("index_images")
    server = server_of(parent)
    stream = Path(f"/proc/{command.pid}/fd/0").readlink()

    def waits() -> bool:
        running = [job for job in children(server) if not has_ended(job)]
        return bool(running) and Path(f"/proc/{running[0]}/fd/0").readlink() == stream

    wait_until(waits)
    return command, next(job for job in children(server) if not has_ended(job))


def signal_job(command: Command, job: int, number: int) -> tuple[int, str]:
    """The status of a job's command after the job got a signal, and what the two said on the terminal."""
    os.kill(job, number)
    out, err = command.communicate(timeout=10)
    return command.returncode, out + err


def has_ended(pid: int) -> bool:
    """Also of one that the server has not asked after yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def call_text(folder: Path, images: Path) -> str:
    """What the rule of index_images tells its job."""
    params = {
        "options": {"camera_model": "auto"},
        "stage_version": 1,
        "settings": {"images": str(images)},
        "seed": 0,
    }
    files = {
        "scene": "s",
        "inputs": {},
        "outputs": [str(folder / "index_images" / "index.h5")],
        "upstream": {},
        "batch_size": "auto",
    }
    return "\n".join([json.dumps(params), json.dumps(files), "1", str(folder / "job.log")]) + "\n"


def test_a_job_has_the_streams_and_the_status_of_its_command(ask, tmp_path: Path) -> None:
    client = ask("no_such_stage")
    out, err = client.communicate(call_text(tmp_path / "out", tmp_path), timeout=30)
    assert (client.returncode, out) == (1, "")
    assert err.startswith("snakesfm: scene 's', no_such_stage: Unexpected ModuleNotFoundError")
    log = (tmp_path / "out" / "job.log").read_text("utf-8")
    assert log.endswith(f"error: {err.removeprefix('snakesfm: scene ').split(': ', 1)[1]}")


def test_a_killed_job_fails_its_command(parent: Command, ask) -> None:
    client, job = waiting_job(parent, ask)
    assert signal_job(client, job, signal.SIGKILL) == (1, "")


def test_a_job_ends_with_its_command(parent: Command, ask) -> None:
    client, job = waiting_job(parent, ask)
    client.kill()
    wait_until(lambda: has_ended(job))
    # and the server goes on
    again, other = waiting_job(parent, ask)
    assert signal_job(again, other, signal.SIGTERM)[0] == 1


def test_jobs_end_with_the_run_though_their_commands_live(
    parent: Command, address: str, ask: Callable[[str], Command], tmp_path: Path
) -> None:
    pipe = Path(address).parent / "run"
    environment = {**os.environ, run_pipe.VARIABLE: str(pipe)}
    forked, job = waiting_job(parent, ask)
    script = Path(__file__).resolve().parents[2] / "scripts" / "index_images.py"
    alone = subprocess.Popen(
        [sys.executable, str(script)],
        stdin=subprocess.PIPE,
        env={**environment, VARIABLE: NO_SERVER},
        text=True,
    )
    wait_until(lambda: pipe in [file.readlink() for file in Path(f"/proc/{alone.pid}/fd").iterdir()])
    parent.kill()
    wait_until(lambda: has_ended(job))
    assert forked.wait(timeout=10) == 1
    alone.communicate(timeout=10)
    assert alone.returncode == -signal.SIGIO
    # and one that comes too late
    wait_until(lambda: not pipe.parent.exists())
    pipe.parent.mkdir()
    os.mkfifo(pipe)
    late = subprocess.run(
        [sys.executable, str(script)],
        input=call_text(tmp_path / "out", tmp_path / "missing"),
        env={**environment, VARIABLE: NO_SERVER},
        text=True,
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (late.returncode, late.stderr) == (1, "")


def test_a_long_name_of_the_folder_for_temporary_files_is_no_hindrance(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 30)
    folder.mkdir()
    environment = {**os.environ, "TMPDIR": str(folder)}
    environment.pop(VARIABLE, None)
    with subprocess.Popen(
        [sys.executable, "-c", PARENT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        address = Path(process.stdout.readline().strip())
        wait_until(address.exists)
        process.communicate("")
    wait_until(lambda: not address.parent.exists())
    assert list(folder.iterdir()) == []


def test_an_interrupt_ends_jobs_and_not_the_server(parent: Command, ask) -> None:
    client, job = waiting_job(parent, ask)
    server = server_of(parent)
    for pid in (server, client.pid):
        os.kill(pid, signal.SIGINT)
    assert signal_job(client, job, signal.SIGINT) == (130, "")
    assert not has_ended(server)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_server_ends_with_who_started_it(
    parent: Command, address: str, number: int, tmp_path: Path
) -> None:
    server = server_of(parent)
    # of which a fork would have none, whereas libraries take them for there
    assert "Threads:\t1\n" in Path(f"/proc/{server}/status").read_text()
    parent.send_signal(number)
    parent.wait(timeout=10)
    wait_until(lambda: not Path(address).parent.exists())
    wait_until(lambda: has_ended(server))
    assert list(tmp_path.iterdir()) == []


def test_jobs_go_on_when_the_server_is_killed(
    parent: Command, address: str, ask: Callable[[str], Command], tmp_path: Path
) -> None:
    command, _ = waiting_job(parent, ask)
    os.kill(server_of(parent), signal.SIGKILL)
    _, err = command.communicate(call_text(tmp_path / "out", tmp_path / "missing"), timeout=60)
    assert command.returncode == 1
    assert err.startswith("snakesfm: scene 's', index_images: ")
    # the next ones do without
    script = Path(__file__).resolve().parents[2] / "scripts" / "index_images.py"
    for value in (address, str(tmp_path / "nothing"), NO_SERVER):
        done = subprocess.run(
            [sys.executable, str(script)],
            input=call_text(tmp_path / "out", tmp_path / "missing"),
            capture_output=True,
            text=True,
            # nor is a pipe missed that is gone
            env={**os.environ, VARIABLE: value, run_pipe.VARIABLE: str(tmp_path / "nothing")},
            timeout=60,
            check=False,
        )
        assert (done.returncode, done.stderr) == (1, err)


def test_no_server_beside_another_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, NO_SERVER)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv(run_pipe.VARIABLE, "")
    server = JobServer()
    server.start({})
    assert server.process is None
    assert os.environ[VARIABLE] == NO_SERVER
    # but jobs end with the run all the same
    assert Path(os.environ[run_pipe.VARIABLE]).is_fifo()
    server.stop()
    assert list(tmp_path.iterdir()) == []


def test_no_server_where_there_is_no_room_for_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    server = JobServer()
    server.start({})
    server.stop()
    assert server.process is None
    assert VARIABLE not in os.environ
