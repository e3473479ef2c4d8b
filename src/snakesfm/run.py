"""The start and the end of a run, as a person sees them."""

import contextlib
import fcntl
import json
import os
import threading
import time
from pathlib import Path
from typing import Any

from snakesfm.errors import ConfigError
from snakesfm.plan import Plan, ScenePlan

LOCK_NAME = ".snakesfm.lock"


class Run:
    """One call of Snakemake: locks the output folder, and says what became of every scene."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.started = time.time()
        self.lock: Any = None

    def start(self) -> None:
        """Take the output folder for this run; the system frees it when the run ends, however it ends.

        Raises
        ------
        ConfigError : another run is writing to the folder, or the folder cannot be written.
        """
        path = self.plan.output / LOCK_NAME
        try:
            self.plan.output.mkdir(parents=True, exist_ok=True)
            self.lock = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"The output folder '{self.plan.output}' cannot be written ({error.strerror}): "
                "say another with --config output=DIR."
            ) from None
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.lock.seek(0)
            raise ConfigError(
                f"Another run ({self.lock.read().strip() or 'unknown'}) is writing to "
                f"'{self.plan.output}': wait for it to end, or give another output=DIR."
            ) from None
        except OSError as error:
            print(f"snakesfm: warning: {path} cannot be locked ({error.strerror}); start one run only.")
        self.lock.truncate(0)
        self.lock.write(f"process {os.getpid()} on {os.uname().nodename}\n")
        self.lock.flush()
        for scene in self.plan.scenes.values():
            print(
                f"snakesfm: scene '{scene.name}': {scene.image_count} image files in {scene.images}, "
                f"{scene.blocks} blocks; logs in {scene.folder / 'logs'}",
                flush=True,
            )

    def finish(self) -> None:
        """One line per scene about its model."""
        _cancel_timers()
        for scene in self.plan.scenes.values():
            print(self.describe(scene), flush=True)

    def fail(self) -> None:
        """One line per scene: its model where it has one, else the sentences of its failed jobs."""
        _cancel_timers()
        for scene in self.plan.scenes.values():
            sentences = self.failures(scene)
            if sentences:
                for sentence in sentences:
                    print(f"snakesfm: scene '{scene.name}' failed: {sentence}", flush=True)
            elif all(Path(file).is_file() for file in scene.final_files()):
                print(self.describe(scene), flush=True)
            else:
                print(
                    f"snakesfm: scene '{scene.name}' is not finished: start the same command again.",
                    flush=True,
                )

    def failures(self, scene: ScenePlan) -> list[str]:
        """The sentences of the scene's jobs that failed in this run, with their logs."""
        sentences = []
        for log in sorted((scene.folder / "logs").rglob("*.log")):
            if log.stat().st_mtime < self.started:
                continue
            lines = log.read_text("utf-8", errors="replace").splitlines()
            if lines and lines[-1].startswith("error: "):
                sentences.append(f"{lines[-1].removeprefix('error: ')} (log: {log})")
        return sentences

    def describe(self, scene: ScenePlan) -> str:
        """How many images are registered, the points, the error, the time, and where the model is."""
        path = scene.folder / "export_model" / "summary.json"
        try:
            summary = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError):
            database = Path(scene.database_file())
            made = f"COLMAP database in {database}, " if database.is_file() else ""
            return f"snakesfm: scene '{scene.name}': {made}no model yet."
        accuracy = ""
        with contextlib.suppress(OSError, ValueError, KeyError):
            metrics = json.loads((scene.folder / "evaluate_model" / "metrics.json").read_text("utf-8"))
            areas = [f"{metrics[f'relative_pose_auc_{degrees}deg']:.1f}" for degrees in (1, 3, 5)]
            accuracy = f", relative-pose AUC {'/'.join(areas)} at 1/3/5 deg"
        return (
            f"snakesfm: scene '{scene.name}': {summary['registered_images']} of {summary['images']} images "
            f"registered, {summary['points']} points, mean reprojection error "
            f"{summary['mean_reprojection_error_px']:.3f} px{accuracy}, "
            f"{time.time() - self.started:.0f} s; model in {path.parent / 'sparse' / '0'}"
        )


def _cancel_timers() -> None:
    """End Snakemake's benchmark timers, which outlive their jobs and hold the process for a second."""
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.cancel()
