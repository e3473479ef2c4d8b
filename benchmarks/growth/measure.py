"""One simulated scene through the workflow, and what its jobs needed."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import h5py
import yaml

from benchmarks import NO_FORKS, ROOT, SOURCES
from benchmarks.machine import describe_machine, today
from snakesfm.blocks import choose_blocks
from snakesfm.job_logs import find_cost
from snakesfm.simulate import Simulation, SimulationOptions

LIBRARIES = ("snakesfm", "snakemake", "pycolmap", "numpy", "scipy", "h5py", "poselib")
TILED = ("match_pairs", "estimate_two_view")
ACCURACY = ("relative_pose_auc_1deg", "relative_pose_auc_5deg", "position_error_percent_median")


@dataclass
class StageNeed:
    """What the jobs of one stage needed."""

    jobs: int = 0
    seconds: float = 0.0
    """Of all jobs, by the clock; not to be trusted on a machine that does other things too."""
    cpu: float = 0.0
    """Of all jobs, seconds of processor."""
    most_cpu: float = 0.0
    """Of the longest job."""
    most_mb: float = 0.0
    """Largest memory of a job."""
    pairs: int = 0
    """Pairs of all jobs, of stages that work on tiles."""


@dataclass
class Measurement:
    """One run."""

    survey: str
    images: int
    blocks: int
    first: str
    """The last stage whose artifacts were simulated; the workflow ran from there."""
    pairs: int = 0
    registered: int = 0
    config: list[str] = field(default_factory=list)
    """Options of the workflow other than the defaults, as ``stage={option: value}``."""
    accuracy: dict[str, float] = field(default_factory=dict)
    stages: dict[str, StageNeed] = field(default_factory=dict)
    made: str = ""
    """Date, machine and versions."""

    def comparable(self, stage: str) -> bool:
        """Whether a stage ran, and with its defaults."""
        return stage in self.stages and stage not in {entry.split("=")[0] for entry in self.config}


def measure(
    options: SimulationOptions,
    folder: Path,
    cores: int,
    last: str = "",
    tiles: int = 0,
    config: Sequence[str] = (),
) -> Measurement:
    """Simulate a scene where it is not there yet, run the workflow, and read its logs.

    Parameters
    ----------
    cores : for Snakemake.
    last : stage after which the workflow stops, "" for none.
    tiles : so many tiles are matched and no more is done; 0 for all.
    config : for Snakemake's ``--config``.
    """
    if not (folder / "config.yaml").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        Simulation(folder, options).run()
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile"), "--quiet"]
    command += ["--profile", str(ROOT / "profiles" / "local"), "--cores", str(cores)]
    command += ["--configfile", str((folder / "config.yaml").resolve())]
    if config:
        command += ["--config", *config]
    if last:
        command += ["--until", last]
    if tiles:
        blocks = options.blocks or choose_blocks(options.images)
        # off the diagonal, where two blocks are read
        names = [f"{k % blocks}-{(k + blocks // 2) % blocks}" for k in range(min(tiles, blocks // 2))]
        scene = folder.resolve() / "results" / folder.name
        command += [str(scene / "estimate_two_view" / f"{name}.h5") for name in names]
    subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **SOURCES, **NO_FORKS},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    result = collect(options, folder)
    result.config = list(config)
    result.made = f"{today()}, {describe_machine(LIBRARIES)}"
    return result


def collect(options: SimulationOptions, folder: Path) -> Measurement:
    """What the logs and the metrics of a scene say."""
    config = yaml.safe_load((folder / "config.yaml").read_text("utf-8"))
    scene = folder / "results" / config["scene"]
    result = Measurement(options.survey, options.images, int(config["blocks"]), options.until)
    for log in sorted(scene.glob("logs/*/*.log")):
        found = find_cost(log.read_text("utf-8"))
        if not found:
            continue
        stage, cpu = found["stage"], float(found["cpu"])
        need = result.stages.setdefault(stage, StageNeed())
        artifact = scene / stage / f"{log.stem}.h5"
        if stage in TILED and artifact.is_file():
            need.pairs += _count_pairs(artifact)
        need.jobs += 1
        need.seconds += float(found["seconds"])
        need.cpu += cpu
        need.most_cpu = max(need.most_cpu, cpu)
        need.most_mb = max(need.most_mb, float(found["mb"]))
    listed = folder / "pairs.txt"
    if listed.is_file():
        result.pairs = len(listed.read_text("utf-8").splitlines())
    else:
        result.pairs = sum(_count_pairs(path) for path in scene.glob("select_pairs/*.h5"))
    metrics = scene / "evaluate_model" / "metrics.json"
    if metrics.is_file():
        content = json.loads(metrics.read_text("utf-8"))
        result.registered = int(content["registered_images"])
        result.accuracy = {name: float(content[name]) for name in ACCURACY}
    return result


def _count_pairs(artifact: Path) -> int:
    with h5py.File(artifact) as file:
        return len(file["pairs"])


def save(measurements: list[Measurement], path: Path) -> None:
    """Write measurements as JSON."""
    path.write_text(json.dumps([asdict(m) for m in measurements], indent=1) + "\n", "utf-8")


def load(path: Path) -> list[Measurement]:
    """Measurements that were saved; none where there is no file."""
    if not path.is_file():
        return []
    rows = json.loads(path.read_text("utf-8"))
    for row in rows:
        row["stages"] = {stage: StageNeed(**need) for stage, need in row["stages"].items()}
    return [Measurement(**row) for row in rows]
