"""Runs all methods on sets, stores every result as it comes, and takes over what is stored."""

import contextlib
import hashlib
import shutil
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from benchmarks.compare import methods
from benchmarks.compare.inputs import source_digest
from benchmarks.compare.measure import CommandError, Cost
from benchmarks.compare.results import GLOBAL, INCREMENTAL, OPENMVG, OURS, OWN, PACKAGES, SAME, Result
from benchmarks.compare.sets import ImageSet
from benchmarks.machine import describe_machine, today
from snakesfm.evaluation.scores import score_model

OPERATIONS = {INCREMENTAL: "map_incremental", GLOBAL: "map_global"}
LARGE_SET = 60
Costs = dict[str, Cost]


@dataclass(frozen=True)
class Campaign:
    """One comparison.

    Attributes
    ----------
    folder : gets results/ and work/SET/.
    seeds, large_seeds : how many seeds, and how many on sets of more than LARGE_SET images.
    threads : of every method.
    limit_s : longest time of one command.
    chosen : methods to run.
    retime : make the first seed again where it was measured while others used the processor.
    """

    folder: Path
    seeds: int
    large_seeds: int
    threads: int
    limit_s: float
    chosen: tuple[str, ...]
    retime: bool = False

    @property
    def results(self) -> Path:
        """Folder of the stored results."""
        return self.folder / "results"

    def run(self, image_set: ImageSet) -> None:
        """All methods on one set."""
        images = len(image_set.image_names())
        seeds = range(self.large_seeds if images > LARGE_SET else self.seeds)
        work = self.folder / "work" / image_set.name
        blank = Result(image_set.name, images, image_set.known, image_set.truth, "", "", 0)
        if OURS in self.chosen:
            for seed in seeds:
                self._run_ours(image_set, work, replace(blank, method=OURS, setting=OWN, seed=seed))
        scene = work / "snakesfm-0" / "out" / image_set.name
        peers = [method for method in OPERATIONS if method in self.chosen]
        if peers:
            self._run_own(image_set, work, replace(blank, setting=OWN), peers, seeds)
            self._run_same(image_set, work, scene, replace(blank, setting=SAME), peers, seeds)
        if OPENMVG in self.chosen:
            for seed in seeds:
                self._run_openmvg(image_set, work, replace(blank, method=OPENMVG, setting=OWN, seed=seed))

    def _run_ours(self, image_set: ImageSet, work: Path, result: Result) -> None:
        """Snakesfm from images to model; of the first seed the database too, beside the measurement."""
        folder = work / f"snakesfm-{result.seed}"
        scene = folder / "out" / image_set.name

        def run() -> Costs:
            shutil.rmtree(folder, ignore_errors=True)
            return methods.snakesfm(image_set, folder, result.seed, self.threads, self.limit_s)

        result = replace(result, inputs=source_digest())
        self._measure(image_set, result, scene / "export_model" / "sparse" / "0", run)
        if result.seed == 0 and not (scene / "export_database" / "database.db").is_file():
            with contextlib.suppress(CommandError):
                methods.snakesfm(image_set, folder, 0, self.threads, self.limit_s, target="databases")
        if result.seed > 0:
            for stage in ("extract_features", "match_pairs", "estimate_two_view"):
                shutil.rmtree(scene / stage, ignore_errors=True)

    def _run_own(
        self, image_set: ImageSet, work: Path, blank: Result, peers: list[str], seeds: range
    ) -> None:
        """COLMAP's mappers after its own front-end, which they share."""
        front = work / "colmap"
        inputs = describe_front_end(len(image_set.camera_groups()))
        runs = [replace(blank, method=m, seed=s, inputs=inputs) for s in seeds for m in peers]
        if all(self.takes_over(result) for result in runs):
            return
        try:
            costs = methods.colmap_front_end(image_set, front, self.threads, self.limit_s)
            if self.retime and not all(cost.undisturbed for cost in costs.values()):
                (front / "cost.json").unlink()
                costs = methods.colmap_front_end(image_set, front, self.threads, self.limit_s)
        except CommandError as error:
            for result in runs:
                _report(replace(result, failure=f"front-end {error}")).write(self.results)
            return
        for result in runs:
            self._map(image_set, work, front / "database.db", result, costs)

    def _run_openmvg(self, image_set: ImageSet, work: Path, result: Result) -> None:
        """OpenMVG from images to model."""
        folder = work / f"openmvg-{result.seed}"

        def run() -> Costs:
            return {"total": methods.openmvg(image_set, folder, result.seed, self.threads, self.limit_s)}

        self._measure(image_set, replace(result, inputs=version("openmvg-rs")), folder / "model", run)

    def _run_same(
        self, image_set: ImageSet, work: Path, scene: Path, blank: Result, peers: list[str], seeds: range
    ) -> None:
        """COLMAP's mappers on the features, pairs and two-view geometries of snakesfm's first seed."""
        database = scene / "export_database" / "database.db"
        if not database.is_file():
            print(f"{image_set.name}: snakesfm left no database, so nothing runs on the same features")
            return
        with database.open("rb") as file:
            inputs = hashlib.file_digest(file, "sha256").hexdigest()
        for seed in seeds:
            for method in peers:
                result = replace(blank, method=method, seed=seed, inputs=inputs)
                self._map(image_set, work, database, result, {})

    def _map(self, image_set: ImageSet, work: Path, database: Path, result: Result, before: Costs) -> None:
        folder = work / f"{result.method}-{result.setting}-{result.seed}"
        calibrate = result.setting == OWN and not image_set.known

        def run() -> Costs:
            cost = methods.colmap_map(
                OPERATIONS[result.method],
                image_set,
                database,
                folder,
                calibrate,
                result.seed,
                self.threads,
                self.limit_s,
            )
            if not before:
                return {"map": cost}
            return {**before, "map": cost, "total": before["extract"] + before["match"] + cost}

        self._measure(image_set, result, folder / "model", run)

    def takes_over(self, result: Result) -> bool:
        """Whether a result is stored that may stand for this run."""
        stored = result.stored(self.results)
        return stored is not None and (stored.undisturbed or not self.retime or result.seed > 0)

    def _measure(self, image_set: ImageSet, result: Result, model: Path, run: Callable[[], Costs]) -> None:
        """Run, evaluate and store, unless that is stored already; a failure is stored too."""
        if self.takes_over(result):
            return
        result = replace(result, date=today(), machine=describe_machine(PACKAGES))
        try:
            result = replace(result, stages=run())
            result = replace(result, metrics=score_model(model, image_set.reference)[0])
        except CommandError as error:
            result = replace(result, failure=str(error), stages={"failed": error.cost})
        except Exception as error:
            traceback.print_exc()
            result = replace(result, failure=f"{type(error).__name__}: {error}")
        _report(result).write(self.results)


def _report(result: Result) -> Result:
    """Say in one line how a run ended."""
    if result.failure:
        text = result.failure
    else:
        found = (result.metrics[f"relative_pose_auc_{degrees}deg"] for degrees in (1, 3, 5))
        areas = ["none" if area is None else f"{area:.1f}" for area in found]
        text = f"{result.metrics['registered_images']} of {result.images} images, AUC {'/'.join(areas)}, "
        text += ", ".join(f"{name} {cost.seconds:.1f} s" for name, cost in result.stages.items())
        text += "" if result.undisturbed else " (disturbed)"
    print(f"{result.image_set} {result.method} {result.setting} seed {result.seed}: {text}", flush=True)
    return result


def describe_front_end(groups: int) -> str:
    """How COLMAP's features are made: by which version and, of several groups of cameras, all at once.

    The number of groups sets these apart from results whose groups were extracted one after the other.
    """
    return version("pycolmap") + (f", {groups} groups of cameras at once" if groups > 1 else "")
