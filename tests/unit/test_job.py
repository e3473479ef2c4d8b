"""What a job reads from standard input, and says where it fails."""

import errno
import hashlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from snakesfm.job import Call, _fail

NAMES = [
    "a b.h5",
    "quote'\".h5",
    "$HOME `date` \\n.h5",
    "{brace}.h5",
    "ünïcödé 写真.h5",
    "new\nline.h5",
    "END OF JOB",
]


def text_of(log: str) -> str:
    files = {"scene": "s", "inputs": {"one": NAMES[0], "all": NAMES}, "outputs": NAMES[1:2]}
    return "\n".join([json.dumps({"seed": 3}), json.dumps(files), "2", log]) + "\n"


@pytest.mark.parametrize("log", ["logs/job.log", "with space/ü.log", "new\nline/job.log"])
def test_a_call_is_read_as_it_was_written(log: str) -> None:
    call = Call.parse("match_pairs", text_of(log))
    assert (call.stage, call.threads, call.log) == ("match_pairs", 2, Path(log))
    assert call.params == {"seed": 3}
    assert call.files == {"scene": "s", "inputs": {"one": NAMES[0], "all": NAMES}, "outputs": NAMES[1:2]}


def test_a_here_document_of_many_files_arrives_unchanged() -> None:
    files = json.dumps({"outputs": NAMES * 8_000})
    code = "import sys, hashlib; print(hashlib.sha256(sys.stdin.buffer.read()).hexdigest())"
    reader = f'exec "{sys.executable}" -c "{code}"'
    script = f"{reader} <<'END OF JOB'\n{files}\nEND OF JOB\n"
    out = subprocess.run(["bash"], input=script, capture_output=True, text=True, check=True).stdout
    assert out.strip() == hashlib.sha256(f"{files}\n".encode()).hexdigest()
    assert len(files) > 1_000_000


def test_a_jobs_memory_is_its_own_and_not_that_of_who_started_it() -> None:
    code = (
        "import subprocess, sys\n"
        "ballast = b'x' * 400_000_000\n"
        "subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)"
    )
    report = "from snakesfm.job import peak_mb; print(peak_mb())"
    out = subprocess.run(
        [sys.executable, "-c", code, report], capture_output=True, text=True, check=True
    ).stdout
    assert 5 < float(out) < 200


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "free the disk or correct the permission, then run again"),
        (errno.EACCES, "free the disk or correct the permission, then run again"),
        (errno.EIO, "start the same command again"),
        (errno.ESTALE, "start the same command again"),
    ],
)
def test_an_error_of_the_system_names_what_helps(
    monkeypatch: pytest.MonkeyPatch, number: int, remedy: str
) -> None:
    monkeypatch.setattr(os, "_exit", lambda status: None)
    terminal = io.StringIO()
    error = OSError(number, "many words", "out/a.h5")
    _fail(
        Call("match_pairs", {}, {"scene": "s", "outputs": ["out/b.h5"]}, 1, Path("job.log")),
        error,
        terminal,
    )
    said = f"snakesfm: scene 's', match_pairs: {os.strerror(number)} 'out/a.h5': {remedy}.\n"
    assert terminal.getvalue() == said


def test_a_lack_of_memory_names_what_helps_on_one_machine_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    statuses: list[int] = []
    monkeypatch.setattr(os, "_exit", statuses.append)
    terminal = io.StringIO()
    _fail(Call("match_pairs", {}, {"scene": "s"}, 1, Path("job.log")), MemoryError(), terminal)
    assert statuses == [1]
    (said,) = terminal.getvalue().splitlines()
    assert said.startswith("snakesfm: scene 's', match_pairs: Not enough memory: use fewer jobs at once")
    assert "--resources mem_mb=MB on one machine" in said and "more mem_mb" in said
    assert capsys.readouterr().out.splitlines() == [f"error: {said.partition('match_pairs: ')[2]}"]
