"""Run the back-end on view graphs with known truth and write a table.

    python -m benchmarks.backend [--sizes 50 300 1000] [--outliers 0 0.1 0.2 0.3 0.4] [--seeds 3]

Needs ViewGraphForge (``pip install -e '.[bench]'``). Every method runs in a process of its own with limits
on time and memory, so one that fails is one row. With ``--positions``, cameras are positioned as well, with
the rotations of each of ``--methods``. ``--add`` keeps the rows of an earlier command on the page.
"""

import argparse
import csv
import shlex
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.backend.apart import Outcome, import_libraries, run_apart
from benchmarks.backend.measures import position_errors_percent, rotation_errors_deg
from benchmarks.backend.methods import METHODS
from benchmarks.backend.positions import POSITIONS, pose_positioning
from benchmarks.backend.problems import (
    FAMILIES,
    LAYOUTS,
    SYMMETRIC_CASES,
    Problem,
    forge,
    lay_out,
    read_real,
    synthesize,
)
from benchmarks.backend.report import Row, describe_origin, render

COLUMNS = (
    "problem", "cameras", "edges", "outliers", "coherent", "seed", "method", "positions",
    "images", "mean_deg", "median_deg", "p90_deg", "mean_percent", "median_percent", "p90_percent",
    "cpu_s", "peak_mib", "failure", "command", "made",
)  # fmt: skip
REAL = ("strecha_castle_p30", "middlebury_temple_ring", "statue_of_liberty_135",
        "sevenscenes_redkitchen_200", "seneca_aerial_167")  # fmt: skip


def main() -> int:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=[50, 300, 1000])
    parser.add_argument("--outliers", type=float, nargs="*", default=[0.0, 0.1, 0.2, 0.3, 0.4])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--layouts", nargs="*", default=list(LAYOUTS))
    parser.add_argument("--sources", nargs="*", default=["forge", "coherent", "layouts", "colmap", "real"])
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    parser.add_argument("--positions", nargs="*", default=[], choices=POSITIONS, help="how to position")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds per method and problem")
    parser.add_argument("--real", type=Path, default=Path("../shared/data/viewgraph_real"))
    parser.add_argument("--csv", type=Path, default=Path("benchmarks_backend.csv"))
    parser.add_argument("--table", type=Path, default=Path("docs/benchmarks_backend.md"))
    parser.add_argument("--add", action="store_true", help="keep the rows that the CSV file has")
    arguments = parser.parse_args()
    command = shlex.join(["python", "-m", "benchmarks.backend", *sys.argv[1:]])
    made = describe_origin()
    import_libraries()
    rows: list[Row] = []
    if arguments.add and arguments.csv.exists():
        with arguments.csv.open(newline="") as file:
            rows = list(csv.DictReader(file))
    with arguments.csv.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
        for problem in problems(arguments):
            for method in arguments.methods:
                for row in measure(problem, method, arguments.positions, arguments.timeout):
                    rows.append(row | {"command": command, "made": made})
                    writer.writerow(rows[-1])
                    file.flush()
                    print(" ".join(row[column] for column in COLUMNS[:-2]), flush=True)
    arguments.table.write_text(render(rows))
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
                if "layouts" in arguments.sources:
                    for layout in arguments.layouts:
                        yield lay_out(layout, cameras, outliers, seed)
                if "colmap" in arguments.sources and cameras <= 300:
                    yield synthesize(cameras, outliers, seed)


def measure(problem: Problem, method: str, positions: list[str], timeout_s: float) -> Iterator[Row]:
    """A row of the rotations by ``method``, and one of each way to position with them."""
    averaged = run_apart(partial(METHODS[method], problem), timeout_s)
    turned = np.zeros(0) if averaged.failure else rotation_errors_deg(averaged.value, problem.truth)
    errors = {"deg": turned}
    yield describe(problem, averaged, errors) | {"method": method}
    if not len(turned) or not len(problem.rays):
        return
    ready = pose_positioning(problem, averaged.value)
    for name in positions:
        placed = run_apart(partial(POSITIONS[name], ready, problem.seed), timeout_s)
        off = np.zeros(0)
        if not placed.failure:
            off = position_errors_percent(averaged.value, placed.value, problem.truth, problem.centers)
        yield describe(problem, placed, errors | {"percent": off}) | {"method": method, "positions": name}


def describe(problem: Problem, outcome: Outcome, errors: dict[str, NDArray[np.float64]]) -> Row:
    """A row of all but the method; ``errors`` (K,) by unit, of which the last says how many images."""
    row = dict.fromkeys(COLUMNS, "") | {
        "problem": problem.name,
        "cameras": str(problem.cameras),
        "edges": str(len(problem.pairs)),
        "outliers": str(problem.outliers),
        "coherent": str(int(problem.coherent)),
        "seed": str(problem.seed),
        "failure": outcome.failure,
    }
    if outcome.failure:
        return row
    images = len(list(errors.values())[-1])
    if images == 0:
        return row | {"images": "0", "failure": "no image has a result"}
    for unit, values in errors.items():
        row |= {
            f"mean_{unit}": f"{values.mean():.4f}",
            f"median_{unit}": f"{np.median(values):.4f}",
            f"p90_{unit}": f"{np.percentile(values, 90):.4f}",
        }
    return row | {
        "images": str(images),
        "cpu_s": f"{outcome.cpu_s:.2f}",
        "peak_mib": f"{outcome.peak_mib:.0f}",
    }


if __name__ == "__main__":
    sys.exit(main())
