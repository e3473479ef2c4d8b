"""The start and the end of a run, with the messages to the user."""

import contextlib
import fcntl
import json
import os
import re
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from typing import Any

from snakesfm import slurm
from snakesfm.errors import ConfigError
from snakesfm.evaluation.summary import describe_accuracy
from snakesfm.job_logs import KILLED, describe_failures
from snakesfm.model_files import SUMMARY, lacks_pictures
from snakesfm.plan import Plan
from snakesfm.records import MAKES_PART, forget, unrecorded_files, was_made_with
from snakesfm.scene_plan import ScenePlan

LOCK_NAME = ".snakesfm.lock"
CONFIGURATION_NAME = ".snakesfm.config.json"
MOST_SENTENCES = 10
IMAGE_COUNTS = "image_counts"
"""Key of the configuration that jobs are given: by scene, how many images the run was planned with."""
FEWER_JOBS = "; if memory ran out, with fewer jobs at once: --cores N or --resources mem_mb=MB"
MORE_FOR_JOBS = (
    "; if memory or time ran out, request more in set-resources of the profile: "
    "RULE: {mem_mb: MB, runtime: MINUTES}"
)
SEE_ABOVE = "; if jobs failed, Snakemake's messages above say why"


class Run:
    """One call of Snakemake: locks the output folder, and says what became of every scene."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.started = time.time()
        # on the clock of the output folder's file system, as soon as that is known
        self.begun = self.started
        self.lock: Any = None
        self.slurm_run = ""
        self.planned: Mapping[str, Set[str]] = {}
        self.interrupted = False

    def note_interrupt(self) -> None:
        """Jobs that are killed from now on are so by the user's own wish."""
        self.interrupted = True

    def refuse_unrecorded(self, asked: Set[str]) -> None:
        """Set aside what other images, options or seeds made and Snakemake knows nothing of.

        Before the jobs are planned, so that they are planned to be made again. What does not say of itself
        how it was made, as a model or a report, is made again and stays until then; so is a model beside
        which pictures are lost.

        Parameters
        ----------
        asked : the words of Snakemake's command line, targets among them.

        Raises
        ------
        ConfigError : another run is writing to the folder.
        """
        with self._beside_no_other():
            for scene in self.plan.scenes.values():
                results = () if asked & MAKES_PART else scene.results(asked)
                outdated = unrecorded_files(results)
                summary = scene.folder / "export_model" / SUMMARY
                exporting = scene.options("export_model").model_dump(include={"link_images", "undistort"})
                if str(summary) in results and lacks_pictures(summary.parent, **exporting):
                    outdated.append(summary)
                for path in outdated:
                    with contextlib.suppress(OSError):
                        forget(path)
                unknown = unrecorded_files(scene.artifacts())
                if unknown:
                    _set_aside(scene, unknown)

    def keep_others_away(self) -> None:
        """Have no other run write to the output folder as long as this process lives.

        For what Snakemake does without jobs, so without :meth:`start`.

        Raises
        ------
        ConfigError : another run is writing to the folder.
        """
        with contextlib.suppress(OSError):
            self.lock = (self.plan.output / LOCK_NAME).open(encoding="utf-8")
            self._lock(self.lock, fcntl.LOCK_SH)

    @contextlib.contextmanager
    def _beside_no_other(self) -> Iterator[None]:
        """Refuse to work beside another run, also without own jobs, and have none start meanwhile."""
        with contextlib.ExitStack() as stack:
            if self.plan.scenes:
                with contextlib.suppress(OSError):
                    lock = stack.enter_context((self.plan.output / LOCK_NAME).open(encoding="utf-8"))
                    self._lock(lock, fcntl.LOCK_SH)
            yield

    def _lock(self, lock: Any, how: int) -> None:
        """Lock the output folder, as far as the file system can, or refuse where another run holds it."""
        try:
            fcntl.flock(lock, how | fcntl.LOCK_NB)
        except BlockingIOError:
            holder, run = _read_note(lock)
            # without the file, nobody would cancel these
            cancel = f"run 'scancel --name={run}' and " if run else ""
            raise ConfigError(
                f"Another run ({holder or 'unknown'}) is writing to '{self.plan.output}': wait for it to "
                "end, or choose another output=DIR; if its machine is down for good, "
                f"{cancel}delete {lock.name}."
            ) from None

    def start(self, slurm_run: str = "") -> None:
        """Take the output folder for this run; the system frees it when the run ends, however it ends.

        Parameters
        ----------
        slurm_run : the name of this run's SLURM jobs; they outlive a run that is killed, so the next run
            reads it in the lock file and cancels them. Empty without SLURM.

        Raises
        ------
        ConfigError : another run is writing to the folder, or the folder cannot be written, or SLURM jobs
            of an interrupted run cannot be ended.
        """
        if self.plan.weights_only:
            return
        path = self.plan.output / LOCK_NAME
        try:
            self.plan.output.mkdir(parents=True, exist_ok=True)
            self.lock = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise ConfigError(
                f"The output folder '{self.plan.output}' cannot be written ({error.strerror}): "
                "choose another one with --config output=DIR."
            ) from None
        try:
            self._lock(self.lock, fcntl.LOCK_EX)
        except OSError as error:
            print(f"snakesfm: warning: {path} cannot be locked ({error.strerror}); start only one run.")
        self._end_former_jobs()
        self.slurm_run = slurm_run
        jobs = f", SLURM run {slurm_run}" if slurm_run else ""
        try:
            self._note(f"process {os.getpid()} on {os.uname().nodename}{jobs}")
            self.begun = os.fstat(self.lock.fileno()).st_mtime
        except OSError as error:
            raise self._lack_of_space(error) from None
        self._bring_times_back()
        for scene in self.plan.scenes.values():
            print(
                f"snakesfm: scene '{scene.name}': {scene.image_count} image files in {scene.images}, "
                f"{scene.blocks} blocks; logs in {scene.folder / 'logs'}",
                flush=True,
            )

    def keep_configuration(self, workflow: Any) -> None:
        """Have jobs that parse the Snakefile anew read this run's configuration, not what is edited since.

        Jobs on one machine parse nothing. Where nodes do not share the sources, Snakemake (9.27) has sent
        them a copy of the files of configuration before.

        Parameters
        ----------
        workflow : Snakemake's, before it starts jobs; the output folder is this run's.

        Raises
        ------
        ConfigError : the folder cannot be written.
        """
        shared = {usage.name for usage in workflow.storage_settings.shared_fs_usage}
        if workflow.local_exec or self.plan.weights_only or not {"SOURCES", "INPUT_OUTPUT"} <= shared:
            return
        # loaded here, as runs on one machine need no h5py
        from snakesfm.artifacts import write_json

        path = (self.plan.output / CONFIGURATION_NAME).absolute()
        # blocks and pairs depend on them, so images that are added meanwhile must not count
        counts = {name: scene.image_count for name, scene in self.plan.scenes.items()}
        try:
            write_json(path, {IMAGE_COUNTS: counts, **self.plan.configuration.model_dump()})
        except OSError as error:
            raise self._lack_of_space(error) from None
        workflow.config_settings.configfiles = [path]

    def _lack_of_space(self, error: OSError) -> ConfigError:
        """What a run says that could lock the output folder and cannot write to it."""
        return ConfigError(
            f"The output folder '{self.plan.output}' cannot be written ({error.strerror}): "
            "free disk space, then run again."
        )

    def _note(self, text: str) -> None:
        """Say in the lock file who holds it."""
        self.lock.truncate(0)
        self.lock.write(f"{text}\n" if text else "")
        self.lock.flush()

    def _end_former_jobs(self) -> None:
        """Cancel what an interrupted run has left in SLURM's queue."""
        former = _read_note(self.lock)[1]
        if former:
            self._end_jobs(former)

    def _end_jobs(self, run: str) -> None:
        """Cancel the SLURM jobs of an interrupted run and wait until they are gone."""
        count = slurm.end_jobs(run, str(self.plan.output), self.lock.name)
        if count:
            print(f"snakesfm: {count} SLURM jobs of an interrupted run were cancelled.", flush=True)

    def _bring_times_back(self) -> None:
        """Give files from the future, which a wrong clock made, the present time, in their order.

        Snakemake refuses the result of a job that looks older than what the job read.
        """
        now = time.time_ns()
        times = {}
        for scene in self.plan.scenes.values():
            for file in scene.all_files():
                with contextlib.suppress(OSError):
                    times[file] = Path(file).stat().st_mtime_ns
        future = sorted((file for file in times if times[file] > now), key=lambda file: (times[file], file))
        for place, file in enumerate(future):
            changed = now - 1_000_000 * (len(future) - place)
            os.utime(file, ns=(changed, changed))
        if future:
            print(
                f"snakesfm: warning: {len(future)} files had times in the future: a clock is or was wrong.",
                flush=True,
            )

    def finish(self, planned: Mapping[str, Set[str]]) -> None:
        """One line per scene about its model.

        Parameters
        ----------
        planned : per scene the rules of the jobs that are done or needed not be: results of other rules may
            be of former images or options.
        """
        if self.plan.weights_only:
            return
        self.planned = planned
        _cancel_timers()
        self._note("")
        for scene in self.plan.scenes.values():
            print(self.describe(scene), flush=True)
            for warning in self._summary(scene).get("warnings", ()):
                print(f"snakesfm: scene '{scene.name}': warning: {warning}", flush=True)

    def fail(
        self, planned: Mapping[str, Set[str]], unfinished: Set[str], on_one_machine: bool = True
    ) -> None:
        """Per scene its model where its jobs are done, else why they are not, and what to do if that helps.

        Parameters
        ----------
        planned : per scene the rules of its jobs, done or not.
        unfinished : the scenes with jobs that are not done.
        on_one_machine : no cluster runs the jobs, so only the user can give a job more memory.
        """
        if self.plan.weights_only:
            return
        self.planned = planned
        _cancel_timers()
        self._leave_slurm()
        for scene in self.plan.scenes.values():
            sentences = describe_failures(scene.folder / "logs", self.begun, self.interrupted)
            for sentence in sentences[:MOST_SENTENCES]:
                print(f"snakesfm: scene '{scene.name}' failed: {sentence}", flush=True)
            if len(sentences) > MOST_SENTENCES:
                more = len(sentences) - MOST_SENTENCES
                print(f"snakesfm: scene '{scene.name}' failed: {more} more jobs.", flush=True)
            killed = any(KILLED in sentence for sentence in sentences)
            if killed or (not sentences and scene.name in unfinished):
                advice = "" if self.interrupted else SEE_ABOVE
                if killed:
                    advice = FEWER_JOBS if on_one_machine else MORE_FOR_JOBS
                print(
                    f"snakesfm: scene '{scene.name}' is not finished: start the same command "
                    f"again{advice}.",
                    flush=True,
                )
            elif not sentences:
                print(self.describe(scene), flush=True)

    def _leave_slurm(self) -> None:
        """Have the next run find nothing to cancel; after an interrupt no job is left.

        Snakemake then cancels those that it knows of, and goes on to submit those that it had begun with.
        """
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            try:
                if self.slurm_run and self.interrupted:
                    self._end_jobs(self.slurm_run)
            except ConfigError as error:
                print(f"snakesfm: {error}", flush=True)
            else:
                if not self.slurm_run or not slurm.list_jobs(self.slurm_run):
                    self._note("")

    def _summary(self, scene: ScenePlan) -> dict[str, Any]:
        """What export_model says of the scene's model; empty where there is none of the present images."""
        return self._read_result(scene, "export_model", SUMMARY)

    def _read_result(self, scene: ScenePlan, stage: str, name: str) -> dict[str, Any]:
        """A result in JSON; empty where it is missing or of former images or options."""
        file = scene.folder / stage / name
        if self._is_outdated(scene, stage, file):
            return {}
        try:
            result: dict[str, Any] = json.loads(file.read_text("utf-8"))
        except (OSError, ValueError):
            return {}
        return result

    def _is_outdated(self, scene: ScenePlan, stage: str, result: Path) -> bool:
        """Whether a result is of former images or options, as where another target was asked for."""
        if stage in self.planned.get(scene.name, ()):
            return False
        try:
            made = result.stat().st_mtime_ns
        except OSError:
            return False
        # files of one stage that are all older than the result were made with the same options
        one_of = {stage: result}
        for file in map(Path, scene.artifacts()):
            with contextlib.suppress(OSError):
                if file.stat().st_mtime_ns > made:
                    return True
                one_of[file.parent.name] = file
        return not all(
            was_made_with(str(file), scene.params(name, {"block": file.stem, "tile": file.stem}, True))
            for name, file in one_of.items()
        )

    def describe(self, scene: ScenePlan) -> str:
        """How many images are registered, the points, the error, the time, and where the results are."""
        database = Path(scene.database_file())
        made = "export_database" in self.planned.get(scene.name, ()) and database.is_file()
        in_database = f"COLMAP database in {database}" if made else ""
        summary = self._summary(scene)
        if not summary:
            is_former = (scene.folder / "export_model" / SUMMARY).is_file()
            older = "the model is older than its images or options: 'all' updates it"
            model = older if is_former else "no model yet"
            return f"snakesfm: scene '{scene.name}': {', '.join(filter(None, (in_database, model)))}."
        others = summary.get("images_in_other_models", [])
        more = f" and {sum(others)} in {len(others)} other models" if others else ""
        accuracy = describe_accuracy(self._read_result(scene, "evaluate_model", "metrics.json"))
        return (
            f"snakesfm: scene '{scene.name}': {summary['registered_images']} of {summary['images']} images "
            f"registered{more}, {summary['points']} points, mean reprojection error "
            f"{summary['mean_reprojection_error_px']:.3f} px{accuracy}, "
            f"{time.time() - self.started:.0f} s; model in {scene.folder / 'export_model' / 'sparse' / '0'}"
            f"{', ' + in_database if in_database else ''}"
        )


def _read_note(lock: Any) -> tuple[str, str]:
    """What a lock file says: who holds it or did so last, and the name of that run's SLURM jobs."""
    lock.seek(0)
    note = lock.read().strip()
    run = re.search(r"SLURM run (\S+)", note)
    return note, run[1] if run else ""


def _set_aside(scene: ScenePlan, unknown: list[Path]) -> None:
    """Rename those of a scene's files that are not as this run would make them, and say so."""
    # loaded here, as most runs know their files and h5py takes a tenth of a second
    from snakesfm.artifacts.checks import ASIDE, set_aside

    found = set_aside(unknown, scene.name, scene.options_digests, scene.settings_text)
    if found:
        print(
            f"snakesfm: scene '{scene.name}': {len(found)} files without a record in this folder's "
            f".snakemake were renamed to *{ASIDE} and will be recreated: {found[0]}.",
            flush=True,
        )


def _cancel_timers() -> None:
    """End the timers of Snakemake's scheduler, which hold the process for a second after the last job."""
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.cancel()
