"""``python -m benchmarks.planning`` measures the controller, and writes the table of docs/cluster.md.

    python -m benchmarks.planning                          # 200, 2,000 and 2,400 jobs
    python -m benchmarks.planning --blocks 13 44 140       # and 20,000, which takes long

This workflow's plan of a small scene that is cut into so many blocks, with the groups of the SLURM profile,
beside a bare Snakefile of the same shape, whose rules only touch a file: its plan, and a real run of all
its jobs on this machine. Seconds are of the processor, and of the controller with all its jobs.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks import ROOT, SOURCES
from benchmarks.marked_tables import replace_table
from snakesfm.blocks import tile_names
from snakesfm.synthetic.render_demo import make_demo
from snakesfm.synthetic.scene import DemoOptions

RECORDS = Path(__file__).with_suffix(".json")
PAGE = ROOT / "docs" / "cluster.md"
SCENE = DemoOptions(image_count=16, width=400, height=300)
SCHEDULING = ("--scheduler", "greedy", "--scheduler-subsample", "50")
BARE = """\
tiles = [f"{a}-{b}" for a in range(config["blocks"]) for b in range(a, config["blocks"])]

rule all:
    input: expand("again/{tile}", tile=tiles)

rule block:
    output: "block/{block}"
    shell: "touch {output}"

rule tile:
    input: lambda wildcards: sorted({f"block/{block}" for block in wildcards.tile.split("-")})
    output: "tile/{tile}"
    shell: "touch {output}"

rule gather:
    input: expand("tile/{tile}", tile=tiles)
    output: "gathered"
    shell: "touch {output}"

rule again:
    input: "gathered", "tile/{tile}"
    output: "again/{tile}"
    shell: "touch {output}"
"""


@dataclass(frozen=True)
class Need:
    """What one call of Snakemake took."""

    seconds: float
    mb: float


@dataclass(frozen=True)
class Planning:
    """What one number of blocks takes."""

    blocks: int
    jobs: int
    """Of the bare Snakefile; this workflow has some twenty more."""
    workflow: Need
    bare: Need
    run: Need


def call(folder: Path, *arguments: str) -> Need:
    """Run Snakemake: processor seconds with its jobs, and its own largest memory."""
    command = [sys.executable, "-m", "snakemake", "--quiet", "all", *arguments]
    with (folder / "snakemake.out").open("wb") as out:
        process = subprocess.Popen(
            command, cwd=folder, env={**os.environ, **SOURCES}, stdout=out, stderr=subprocess.STDOUT
        )
        largest, ended = 0, 0
        while not ended:
            time.sleep(0.1)
            # what wait4 says of memory holds that of this process before exec
            found = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{process.pid}/status").read_text())
            largest = int(found[1]) if found else largest
            ended, status, usage = os.wait4(process.pid, os.WNOHANG)
    if status:
        raise SystemExit((folder / "snakemake.out").read_text("utf-8", errors="replace"))
    return Need(usage.ru_utime + usage.ru_stime, largest / 1024)


def measure(scene: Path, folder: Path, blocks: int) -> Planning:
    """Plan this workflow, plan the bare one, and run that.

    Parameters
    ----------
    scene : a folder with ``images``.
    folder : a new folder.
    blocks : number of blocks.
    """
    folder.mkdir()
    (folder / "bare.smk").write_text(BARE)
    config = [f"images={scene / 'images'}", f"blocks={blocks}", "output=out"]
    profile = ROOT / "profiles" / "slurm"
    bare = ["--snakefile", "bare.smk", "--cores", str(os.cpu_count()), *SCHEDULING]
    bare += ["--config", f"blocks={blocks}"]
    return Planning(
        blocks,
        blocks + 2 * len(tile_names(blocks)) + 1,
        call(
            folder,
            *("--snakefile", str(ROOT / "Snakefile"), "--profile", str(profile), "--dry-run"),
            *("--config", *config),
        ),
        call(folder, *bare, "--dry-run"),
        call(folder, *bare),
    )


def table(found: list[Planning]) -> str:
    """One row of Markdown for each number of blocks."""
    lines = [
        "| jobs | blocks | this workflow: s | MB | bare, plan: s | MB | bare, run: s | MB | jobs per s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in found:
        numbers = [f"{need.seconds:.1f} | {need.mb:.0f}" for need in (row.workflow, row.bare, row.run)]
        speed = f"{row.jobs / row.run.seconds:.0f}"
        lines.append(f"| {' | '.join([f'{row.jobs:,}', str(row.blocks), *numbers, speed])} |")
    return "\n".join(lines) + "\n"


def load() -> list[Planning]:
    """What was measured before."""
    rows = json.loads(RECORDS.read_text("utf-8")) if RECORDS.is_file() else []
    needs = ("workflow", "bare", "run")
    return [Planning(**{k: Need(**v) if k in needs else v for k, v in row.items()}) for row in rows]


def main() -> None:
    """Measure what is asked for, keep it, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--blocks", type=int, nargs="*", default=[13, 44, 48], help="numbers of blocks")
    given = parser.parse_args()
    found = load()
    with tempfile.TemporaryDirectory(prefix="planning") as name:
        make_demo(Path(name) / "scene", SCENE)
        for blocks in given.blocks:
            fresh = measure(Path(name) / "scene", Path(name) / str(blocks), blocks)
            print(fresh, flush=True)
            found = sorted(
                [*(row for row in found if row.blocks != blocks), fresh], key=lambda row: row.blocks
            )
            RECORDS.write_text(json.dumps([asdict(row) for row in found], indent=1) + "\n", "utf-8")
    replace_table(PAGE, "python -m benchmarks.planning", table(found))


if __name__ == "__main__":
    main()
