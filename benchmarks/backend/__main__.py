"""Run the back-end on view graphs with known truth and write a table.

    python -m benchmarks.backend [--sizes 50 300 1000] [--outliers 0 0.1 0.2 0.3 0.4] [--seeds 3]

Needs ViewGraphForge (``pip install -e '.[bench]'``). Every method runs in a process of its own with limits
on time and memory, so one that fails is one row.
"""

import argparse
import csv
import importlib.metadata
import multiprocessing
import os
import platform
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.backend.measures import rotation_errors_deg
from benchmarks.backend.methods import METHODS
from benchmarks.backend.problems import FAMILIES, SYMMETRIC_CASES, Problem, forge, read_real, synthesize

COLUMNS = (
    "problem", "cameras", "edges", "outliers", "coherent", "seed", "method",
    "images", "mean_deg", "median_deg", "p90_deg", "cpu_s", "peak_mib", "failure",
)  # fmt: skip
MEMORY_BYTES = 8 << 30
REAL = ("strecha_castle_p30", "middlebury_temple_ring", "statue_of_liberty_135",
        "sevenscenes_redkitchen_200", "seneca_aerial_167")  # fmt: skip


def main() -> int:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=[50, 300, 1000])
    parser.add_argument("--outliers", type=float, nargs="*", default=[0.0, 0.1, 0.2, 0.3, 0.4])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--sources", nargs="*", default=["forge", "coherent", "colmap", "real"])
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds per method and problem")
    parser.add_argument("--real", type=Path, default=Path("../shared/data/viewgraph_real"))
    parser.add_argument("--csv", type=Path, default=Path("benchmarks_backend.csv"))
    parser.add_argument("--table", type=Path, default=Path("docs/benchmarks_backend.md"))
    arguments = parser.parse_args()
    rows = []
    with arguments.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for problem in problems(arguments):
            for method in arguments.methods:
                rows.append(measure(problem, method, arguments.timeout))
                writer.writerow(rows[-1])
                file.flush()
                print(" ".join(str(rows[-1][column]) for column in COLUMNS), flush=True)
    arguments.table.write_text(render(rows, " ".join(sys.argv[1:])))
    return 0


def problems(arguments: argparse.Namespace) -> Iterator[Problem]:
    """The problems that the arguments ask for, one at a time."""
    if "real" in arguments.sources:
        for name in REAL:
            if (arguments.real / f"{name}.EGs.txt").exists():
                yield read_real(arguments.real, name)
    for cameras in arguments.sizes:
        for outliers in arguments.outliers:
            for seed in range(arguments.seeds):
                for family in arguments.families:
                    if "forge" in arguments.sources:
                        yield forge(family, cameras, outliers, False, seed)
                    if "coherent" in arguments.sources and family in SYMMETRIC_CASES:
                        yield forge(family, cameras, outliers, True, seed)
                if "colmap" in arguments.sources and cameras <= 300:
                    yield synthesize(cameras, outliers, seed)


def measure(problem: Problem, method: str, timeout_s: float) -> dict[str, Any]:
    """One row: the method in a child process."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "")
    row |= {
        "problem": problem.name,
        "cameras": problem.cameras,
        "edges": len(problem.pairs),
        "outliers": problem.outliers,
        "coherent": int(problem.coherent),
        "seed": problem.seed,
        "method": method,
    }
    context = multiprocessing.get_context("fork")
    receiving, sending = context.Pipe(duplex=False)
    child = context.Process(target=_run, args=(problem, method, sending))
    child.start()
    sending.close()
    if receiving.poll(timeout_s):
        try:
            row |= receiving.recv()
        except EOFError:
            child.join()
            row["failure"] = f"ended with exit code {child.exitcode}"
    else:
        row["failure"] = f"not done in {timeout_s:.0f} s"
        child.kill()
    child.join()
    return row


def _run(problem: Problem, method: str, sending: Any) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    start = time.process_time()
    try:
        averaged = METHODS[method](problem)
    except Exception as fault:
        sending.send({"failure": f"{type(fault).__name__}: {fault}"[:200]})
        return
    seconds = time.process_time() - start
    errors = rotation_errors_deg(averaged, problem.truth)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if len(errors) == 0:
        sending.send({"images": 0, "failure": "no image has a rotation"})
        return
    sending.send(
        {
            "images": len(errors),
            "mean_deg": f"{errors.mean():.4f}",
            "median_deg": f"{np.median(errors):.4f}",
            "p90_deg": f"{np.percentile(errors, 90):.4f}",
            "cpu_s": f"{seconds:.2f}",
            "peak_mib": f"{peak:.0f}",
        }
    )


def render(rows: list[dict[str, Any]], command: str) -> str:
    """Markdown: median over seeds and, in brackets, its spread, of mean and median rotation error."""
    versions = ", ".join(
        f"{name} {importlib.metadata.version(name)}" for name in ("snakesfm", "pycolmap", "gtsam", "numpy")
    )
    lines = [
        "# The back-end on view graphs with known truth",
        "",
        f"{date.today().isoformat()}, {os.cpu_count()} cores, {platform.machine()}, Python"
        f" {platform.python_version()}, {versions}. Made by `python -m benchmarks.backend {command}`.",
        "",
        "Rotation errors in degrees after alignment by the median rotation: median over seeds of the mean"
        " error (smallest to largest), and of the median error. *Ratio* is to COLMAP's default on the same"
        " problems. *Oracle* is weighted least squares on the right edges alone, started at the truth."
        " Seconds are of the processor.",
        "",
        "| problem | cameras | outliers | coherent | method | images"
        " | mean | ratio | median | ratio | s | MiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[tuple(row[key] for key in ("problem", "cameras", "outliers", "coherent", "method"))].append(
            row
        )
    for key, group in groups.items():
        name, cameras, outliers, coherent, method = key
        done = [row for row in group if not row["failure"]]
        head = f"| {name} | {cameras} | {outliers:.0%} | {'yes' if coherent else 'no'} | {method} |"
        if not done:
            lines.append(f"{head} {group[0]['failure']} | | | | | | |")
            continue
        means, medians = ([float(row[column]) for row in done] for column in ("mean_deg", "median_deg"))
        base = [row for row in groups.get((*key[:4], "colmap"), []) if not row["failure"]]
        ratios = [
            f"{np.median(values) / np.median([float(row[column]) for row in base]):.2f}" if base else ""
            for values, column in ((means, "mean_deg"), (medians, "median_deg"))
        ]
        cells = [
            f"{np.median([row['images'] for row in done]):.0f}",
            f"{np.median(means):.3f} ({min(means):.3f} to {max(means):.3f})",
            ratios[0],
            f"{np.median(medians):.3f}",
            ratios[1],
            f"{np.median([float(row['cpu_s']) for row in done]):.1f}",
            f"{max(float(row['peak_mib']) for row in done):.0f}",
        ]
        lines.append(f"{head} {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
