"""What was measured, one JSON file per set, method, setting and seed."""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from benchmarks.compare.measure import Cost
from benchmarks.compare.methods import GROUPS, job_counts
from snakesfm.artifacts import write_json

OURS = "snakesfm"
INCREMENTAL = "colmap_incremental"
GLOBAL = "colmap_global"
OPENMVG = "openmvg_global"
METHODS = (OURS, INCREMENTAL, GLOBAL, OPENMVG)
PEERS = (INCREMENTAL, GLOBAL)
OWN, SAME = "own", "same"
SETTINGS = (OWN, SAME)
PACKAGES = ("snakesfm", "pycolmap", "openmvg-rs", "snakemake", "opencv-python-headless", "poselib", "numpy")


@dataclass(frozen=True)
class Result:
    """One run.

    Attributes
    ----------
    image_set, images, known, truth : name, number of images, whether intrinsics were given, and whether the
        reference is no COLMAP model of these images.
    method, setting, seed : which of METHODS, with its own front-end or on the same features as snakesfm.
    failure : why there is no model; empty where there is one.
    metrics : the project's own evaluation of the model.
    stages : cost of extract, match, map and total; those that the setting has. Of snakesfm the first three
        are what its jobs measured of themselves; see ``share_out``.
    inputs : digest of what the run started from; a result of other inputs is made again.
    machine : that it was measured on, and the versions; empty where it was stored without.
    """

    image_set: str
    images: int
    known: bool
    truth: bool
    method: str
    setting: str
    seed: int
    inputs: str = ""
    failure: str = ""
    date: str = ""
    machine: str = ""
    metrics: dict[str, Any] = field(default_factory=dict)
    stages: dict[str, Cost] = field(default_factory=dict)

    def path(self, folder: Path) -> Path:
        """Its file below the folder of results."""
        return folder / f"{self.image_set}.{self.method}.{self.setting}.{self.seed}.json"

    def write(self, folder: Path) -> None:
        """Store it."""
        write_json(self.path(folder), asdict(self))

    def stored(self, folder: Path) -> "Result | None":
        """The stored result of the same run with the same inputs."""
        path = self.path(folder)
        result = read_result(path) if path.is_file() else None
        if result is None or (result.inputs, result.known) != (self.inputs, self.known):
            return None
        return result

    @property
    def undisturbed(self) -> bool:
        """Whether its wall clock may be trusted."""
        return all(cost.undisturbed for cost in self.stages.values())


def read_result(path: Path) -> Result:
    """Read one stored result."""
    content = json.loads(path.read_text("utf-8"))
    content["stages"] = {name: Cost(**cost) for name, cost in content["stages"].items()}
    return Result(**content)


def share_out(result: Result) -> Result:
    """Give each group of snakesfm's stages its share of what its run took beside what the jobs measured.

    That is Snakemake, the start of jobs with the import of libraries, and what comes after the model. A
    peer's cost is that of its whole process, so snakesfm's must hold them too; each job gets as much.
    """
    if result.method != OURS or "total" not in result.stages:
        return result
    jobs = job_counts(result.images)
    groups = {name: cost for name, cost in result.stages.items() if name in GROUPS}
    rest = result.stages["total"].cpu_seconds - sum(cost.cpu_seconds for cost in groups.values())
    of_a_job = max(rest, 0.0) / sum(jobs.values())
    shares = {
        name: replace(cost, cpu_seconds=round(cost.cpu_seconds + of_a_job * jobs[name], 2))
        for name, cost in groups.items()
    }
    return replace(result, stages={**result.stages, **shares})


def read_results(folder: Path) -> list[Result]:
    """All stored results, to be compared: snakesfm's with the costs of :func:`share_out`.

    snakesfm's are also those of the setting SAME, which it shares by definition.
    """
    results = [share_out(read_result(path)) for path in sorted(folder.glob("*.json"))]
    shared = [
        replace(result, setting=SAME, stages={k: v for k, v in result.stages.items() if k == "map"})
        for result in results
        if result.method == OURS
    ]
    return results + shared
