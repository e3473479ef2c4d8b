"""The table of front-ends: pose AUC after bundle adjustment, front-end by image set.

    python -m benchmarks.front_ends --out DIR --weights DIR [--sets NAME ...] [--front-ends NAME ...]

Every front-end reconstructs every set with the workflow as users run it, into DIR/FRONT_END/SET; started
again it goes on where it was. DIR/front_ends.json and .md hold what is there so far.
"""

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.compare.measure import ROOT, CommandError
from benchmarks.compare.methods import snakesfm
from benchmarks.compare.sets import ImageSet, read_sets
from snakesfm.errors import SnakesfmError
from snakesfm.front_ends import FRONT_ENDS

DATA = ROOT.parent / "shared" / "data"
DEGREES = ("1", "2.5", "5", "10", "20")
# the oracle reads the answer, and what is imported is another program's
COMPARED = tuple(name for name in FRONT_ENDS if name not in ("virtual", "virtual_places", "imported"))


def measure(
    image_set: ImageSet, front_end: str, out: Path, options: Sequence[str], threads: int, limit_s: float
) -> dict[str, Any]:
    """Reconstruct one set with one front-end: metrics and processor time, or why it failed."""
    folder = out / front_end
    try:
        config = [f"front_end={front_end}", *options]
        costs = snakesfm(image_set, folder, 0, threads, limit_s, config)
    except CommandError as error:
        return {"failure": str(error)}
    path = folder / "out" / image_set.name / "evaluate_model" / "metrics.json"
    metrics = json.loads(path.read_text("utf-8"))
    names = ["reference_images", "reference_images_registered", "track_length_mean"]
    names += [f"pose_auc_{degrees}deg" for degrees in DEGREES]
    chosen = {name: metrics[name] for name in names}
    return {**chosen, "cpu_seconds": costs["extract"].cpu_seconds + costs["match"].cpu_seconds}


def render(values: Mapping[str, Mapping[str, Any]], sets: Sequence[str], front_ends: Sequence[str]) -> str:
    """Markdown: a table per set of AUC at five thresholds, and the mean over the sets that all finished."""
    lines = [
        "# Front-ends",
        "",
        "Pose AUC in percent after bundle adjustment, of all reference images.",
    ]
    head = ["front-end", *(f"@{degrees}°" for degrees in DEGREES), "registered", "front-end's CPU s"]
    for name in sets:
        lines += ["", f"## {name}", "", _row(head), _row(["---"] * len(head))]
        for front_end in front_ends:
            value = values.get(f"{name}|{front_end}", {})
            if "failure" in value or not value:
                lines.append(_row([front_end, value.get("failure", "not run"), *[""] * (len(head) - 2)]))
                continue
            areas = [f"{value[f'pose_auc_{degrees}deg']:.1f}" for degrees in DEGREES]
            registered = f"{value['reference_images_registered']} of {value['reference_images']}"
            lines.append(_row([front_end, *areas, registered, f"{value['cpu_seconds']:.0f}"]))
    complete = [name for name in sets if all(_finished(values, name, one) for one in front_ends)]
    if complete:
        lines += ["", f"## Mean of {len(complete)} sets", "", _row(head[:6]), _row(["---"] * 6)]
        for front_end in front_ends:
            found = [values[f"{name}|{front_end}"] for name in complete]
            means = [sum(one[f"pose_auc_{d}deg"] for one in found) / len(found) for d in DEGREES]
            lines.append(_row([front_end, *(f"{mean:.1f}" for mean in means)]))
    return "\n".join(lines) + "\n"


def _finished(values: Mapping[str, Mapping[str, Any]], name: str, front_end: str) -> bool:
    return "cpu_seconds" in values.get(f"{name}|{front_end}", {})


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def main(arguments: list[str]) -> int:
    """Run what is asked for and write the tables; 1 where a set is not there."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.front_ends",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of results and working files")
    parser.add_argument("--weights", type=Path, required=True, help="folder that fetch_weights filled")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the image sets")
    parser.add_argument("--sets", nargs="*", default=[], help="names of sets (all)")
    parser.add_argument("--front-ends", nargs="*", choices=COMPARED, default=list(COMPARED))
    parser.add_argument("--options", nargs="*", default=[], help="more items for --config of every run")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--limit", type=float, default=7200, help="longest time of one run in seconds")
    given = parser.parse_args(arguments)
    out = given.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    store = out / "front_ends.json"
    values: dict[str, dict[str, Any]] = json.loads(store.read_text("utf-8")) if store.is_file() else {}
    options = [f"weights={given.weights.resolve()}", *given.options]
    try:
        sets = read_sets(given.data, given.sets)
    except SnakesfmError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    for image_set in sets:
        for front_end in given.front_ends:
            key = f"{image_set.name}|{front_end}"
            values[key] = measure(image_set, front_end, out, options, given.threads, given.limit)
            print(f"{key}: {values[key]}", flush=True)
            store.write_text(json.dumps(values, indent=1, sort_keys=True) + "\n", "utf-8")
            names = [one.name for one in sets]
            (out / "front_ends.md").write_text(render(values, names, given.front_ends), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
