"""Runs the workflow as a user does, in a folder of the test's own."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from snakemake_forks import call_snakemake

from snakesfm.job import THREAD_VARIABLES

ROOT = Path(__file__).resolve().parents[1]


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
    profile: str = "local"
    environment: Mapping[str, str] | None = None

    def command(self, *arguments: str, cores: int = 2) -> list[str]:
        return [sys.executable, "-m", "snakemake", *self._arguments(*arguments, cores=cores)]

    def _arguments(self, *arguments: str, cores: int) -> list[str]:
        common = [
            "--snakefile",
            str(ROOT / "Snakefile"),
            "--profile",
            str(ROOT / "profiles" / self.profile),
        ]
        if self.profile == "local":
            common += ["--cores", str(cores)]
        return [*common, *arguments]

    def _user_environment(self) -> dict[str, str]:
        """The environment without the limits of the tests' own threads: jobs limit theirs themselves."""
        environment = os.environ if self.environment is None else self.environment
        return {name: value for name, value in environment.items() if name not in THREAD_VARIABLES}

    def run(self, *arguments: str, cores: int = 2, timeout: float = 300) -> Outcome:
        """Run to the end, without the time that the command takes to load Snakemake."""
        with tempfile.NamedTemporaryFile() as log:
            status = call_snakemake(
                self._arguments(*arguments, cores=cores),
                self.folder,
                self._user_environment(),
                Path(log.name),
                timeout,
            )
            return Outcome(status, Path(log.name).read_text("utf-8"))

    def metrics_of(self, scene: Path, *options: str, timeout: float = 300) -> dict:
        """Reconstruct a scene with a reference, and compare the two."""
        outcome = self.run(*config_of(scene, *options), timeout=timeout)
        assert outcome.status == 0, outcome.text
        return json.loads(
            (self.folder / "out" / scene.name / "evaluate_model" / "metrics.json").read_text()
        )

    def start(self, *arguments: str, cores: int = 2) -> "subprocess.Popen[str]":
        """Start a run whose output can be read when it has ended."""
        return subprocess.Popen(
            self.command(*arguments, cores=cores),
            cwd=self.folder,
            env=self._user_environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            # a shell has its background jobs ignore Ctrl-C, and so would what they start
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def kill_when(
        self, condition: Callable[[], bool], *arguments: str, number: int = signal.SIGKILL
    ) -> None:
        """Start a run and kill all its processes as soon as a condition holds."""
        with subprocess.Popen(
            self.command(*arguments),
            cwd=self.folder,
            env=self._user_environment(),
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


def config_of(scene: Path, *options: str, output: str = "out") -> list[str]:
    """The arguments of a run on a scene with a reference, and on options beside these."""
    folders = (f"images={scene / 'images'}", f"reference={scene / 'reference'}", f"output={output}")
    return ["--config", *folders, *options]


def copy_run(output: Path, folder: Path) -> None:
    """Copy a finished run, with Snakemake's records, so that a test may disturb it."""
    shutil.copytree(output.parent, folder / "out", symlinks=True)
    shutil.copytree(output.parents[1] / ".snakemake", folder / ".snakemake", symlinks=True)


def model_bytes(output: Path) -> dict[str, bytes]:
    """The files of the exported model."""
    folder = output / "export_model" / "sparse" / "0"
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
