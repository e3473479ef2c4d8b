"""pycolmap leaves the signal that ends a process as it was."""

import signal
import subprocess
import sys

import pytest

LOAD = "import os, signal, sys; from snakesfm.geometry.colmap_binding import pycolmap; "
END = "os.kill(os.getpid(), signal.SIGTERM)"
HANDLE = "import signal; signal.signal(signal.SIGTERM, lambda *_: sys.exit(7)); "


@pytest.mark.parametrize(
    ("before", "status"), [("", -signal.SIGTERM), (HANDLE, 7)], ids=["by default", "with a handler"]
)
def test_a_process_that_is_told_to_end_ends_at_once_and_says_nothing(before: str, status: int) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", before + LOAD + END], capture_output=True, text=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (status, "")
