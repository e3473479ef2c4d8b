"""``python -m benchmarks.nodes`` measures what SLURM costs, and writes the table of docs/cluster.md.

    python -m benchmarks.nodes                          # a local run, and 2, 4 and 8 virtual nodes, twice
    python -m benchmarks.nodes --nodes 4 --repeats 1    # the rows of other numbers stay as they were

The whole workflow runs on a small scene: locally with two jobs at once, then on a disposable SLURM of so
many virtual nodes on this machine, with the profile as it is. It needs slurm-wlm, munge and the extra
'slurm', and a machine that nobody else uses: what others took before each run stands in the table.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks import ROOT, SOURCES
from benchmarks.marked_tables import replace_table
from snakesfm.job_logs import find_cost
from snakesfm.synthetic.render_demo import make_demo
from snakesfm.synthetic.scene import DemoOptions
from tests.slurm_cluster import Cluster, missing_programs

RECORDS = Path(__file__).with_suffix(".json")
PAGE = ROOT / "docs" / "cluster.md"
SCENE = DemoOptions(image_count=16, width=400, height=300)
CPUS_PER_NODE = 2
LOCAL_CORES = 2
QUIET_S = 5.0


@dataclass(frozen=True)
class NodesRun:
    """One run of the workflow."""

    nodes: int
    """Virtual nodes; 0 for a local run."""
    wall_s: float
    busy_s: float
    """Processor time of the whole machine during the run."""
    stages_s: float
    """Processor time of the stages alone, from their logs."""
    slurm_jobs: int
    others: float
    """Cores that were busy in the seconds before the run."""


def busy_seconds() -> float:
    """Processor time of the whole machine since it started."""
    user, nice, system, *_ = map(int, Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:])
    return (user + nice + system) / os.sysconf("SC_CLK_TCK")


def busy_cores() -> float:
    """Cores that are busy now, on average over some seconds."""
    before = busy_seconds()
    time.sleep(QUIET_S)
    return (busy_seconds() - before) / QUIET_S


def run_workflow(scene: Path, folder: Path, cluster: Cluster | None) -> NodesRun:
    """Reconstruct the scene once.

    Parameters
    ----------
    scene : a folder with ``images`` and ``reference``.
    folder : a new folder for the results.
    cluster : where the jobs run; None for this machine.
    """
    folder.mkdir()
    profile = ROOT / "profiles" / ("slurm" if cluster else "local")
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")]
    command += ["--profile", str(profile), *([] if cluster else ["--cores", str(LOCAL_CORES)])]
    command += ["--config", f"images={scene / 'images'}", f"reference={scene / 'reference'}", "output=out"]
    earlier = len(cluster.jobs("COMPLETED")) if cluster else 0
    others = busy_cores()
    started, busy = time.monotonic(), busy_seconds()
    done = subprocess.run(
        command,
        cwd=folder,
        env={**(cluster.environment if cluster else os.environ), **SOURCES},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    wall, busy = time.monotonic() - started, busy_seconds() - busy
    if done.returncode:
        raise SystemExit(f"{done.stdout}\nThe workflow failed with status {done.returncode}; see above.")
    found = [find_cost(log.read_text("utf-8")) for log in folder.glob("out/*/logs/*/*.log")]
    stages = sum(float(cost["cpu"]) for cost in found if cost)
    jobs = len(cluster.jobs("COMPLETED")) - earlier if cluster else 0
    return NodesRun(len(cluster.names) if cluster else 0, wall, busy, stages, jobs, others)


def measure(nodes: list[int], repeats: int) -> list[NodesRun]:
    """A local run and one on each number of nodes, so many times."""
    runs = []
    with tempfile.TemporaryDirectory(prefix="nodes") as name:
        scene = Path(name) / "scene"
        make_demo(scene, SCENE)
        for repeat in range(repeats):
            runs.append(run_workflow(scene, Path(name) / f"local-{repeat}", None))
            print(runs[-1], flush=True)
            for count in nodes:
                # a socket's path must be short
                with tempfile.TemporaryDirectory(prefix="slurm") as slurm:
                    cluster = Cluster(Path(slurm), nodes=count, cpus=CPUS_PER_NODE)
                    try:
                        cluster.start()
                        runs.append(run_workflow(scene, Path(name) / f"{count}-{repeat}", cluster))
                    finally:
                        cluster.stop()
                print(runs[-1], flush=True)
    return runs


def table(runs: list[NodesRun]) -> str:
    """The quickest run of each number of nodes as rows of Markdown."""
    lines = [
        "| where | SLURM jobs | wall, s | processor, s | of that, the stages | cores busy before |",
        "|---|---|---|---|---|---|",
    ]
    for nodes in sorted({run.nodes for run in runs}):
        best = min((run for run in runs if run.nodes == nodes), key=lambda run: run.wall_s)
        where = f"SLURM, {nodes} nodes" if nodes else f"local, {LOCAL_CORES} jobs at once"
        numbers = [str(best.slurm_jobs or ""), f"{best.wall_s:.0f}", f"{best.busy_s:.0f}"]
        lines.append(f"| {' | '.join([where, *numbers, f'{best.stages_s:.0f}', f'{best.others:.1f}'])} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure what is asked for, keep it, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nodes", type=int, nargs="*", default=[2, 4, 8], help="numbers of virtual nodes")
    parser.add_argument("--repeats", type=int, default=2, help="the quickest run counts")
    given = parser.parse_args()
    if missing_programs():
        parser.error(f"not installed: {', '.join(missing_programs())} (Debian: slurm-wlm, munge)")
    fresh = measure(given.nodes, given.repeats)
    kept = [NodesRun(**row) for row in json.loads(RECORDS.read_text("utf-8"))] if RECORDS.is_file() else []
    again = {run.nodes for run in fresh}
    runs = sorted([*(run for run in kept if run.nodes not in again), *fresh], key=lambda run: run.nodes)
    RECORDS.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n", "utf-8")
    replace_table(PAGE, "python -m benchmarks.nodes", table(runs))


if __name__ == "__main__":
    main()
