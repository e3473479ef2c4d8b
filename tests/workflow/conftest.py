"""A small rendered scene, and a way to run the workflow on it."""

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from snakesfm.synthetic.render_demo import make_demo
from snakesfm.synthetic.scene import DemoOptions

ROOT = Path(__file__).resolve().parents[2]
SMALL = DemoOptions(image_count=16, width=400, height=300)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a call of Snakemake did."""

    status: int
    text: str

    @property
    def rules(self) -> list[str]:
        """The rules of the jobs that were started, with repetitions, the target's left out."""
        return [rule for rule in re.findall(r"^(?:local)?rule (\w+):", self.text, re.M) if rule != "all"]

    @property
    def summary(self) -> list[str]:
        """The lines that snakesfm itself printed, start lines left out."""
        return [line for line in self.text.splitlines() if line.startswith("snakesfm: scene")]


@dataclasses.dataclass(frozen=True)
class Workflow:
    """Runs Snakemake in a folder of its own."""

    folder: Path

    def command(self, *arguments: str, cores: int = 2) -> list[str]:
        base = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")]
        profile = ["--profile", str(ROOT / "profiles" / "local"), "--cores", str(cores)]
        return [*base, *profile, *arguments]

    def run(self, *arguments: str, cores: int = 2, timeout: float = 300) -> Outcome:
        done = subprocess.run(
            self.command(*arguments, cores=cores),
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout,
            check=False,
        )
        return Outcome(done.returncode, done.stdout)

    def kill_when(
        self, condition: Callable[[], bool], *arguments: str, number: int = signal.SIGKILL
    ) -> None:
        """Start a run and kill all its processes as soon as a condition holds."""
        with subprocess.Popen(
            self.command(*arguments),
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        ) as process:
            limit = time.monotonic() + 120
            while not condition() and process.poll() is None and time.monotonic() < limit:
                time.sleep(0.02)
            assert process.poll() is None, "the run ended before it could be killed"
            os.killpg(process.pid, number)
            process.wait(60)


@pytest.fixture
def workflow(tmp_path: Path) -> Workflow:
    return Workflow(tmp_path)


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered scene of 16 small images with its reference."""
    folder = tmp_path_factory.mktemp("scene") / "square"
    make_demo(folder, SMALL)
    return folder


@pytest.fixture(scope="session")
def finished(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """The small scene reconstructed once without disturbance: its output folder and what was printed."""
    folder = tmp_path_factory.mktemp("finished")
    config = [f"images={small_scene / 'images'}", f"reference={small_scene / 'reference'}", "output=out"]
    outcome = Workflow(folder).run("--config", *config)
    assert outcome.status == 0, outcome.text
    return folder / "out" / "square", outcome
