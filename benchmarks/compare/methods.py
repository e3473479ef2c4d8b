"""The methods that are compared: each goes from images, or from an exported database, to a model."""

import json
import re
import shutil
import sys
from collections.abc import Iterable
from dataclasses import asdict
from datetime import datetime
from pathlib import Path

from benchmarks import ROOT
from benchmarks.compare.inputs import inputs_of
from benchmarks.compare.measure import Cost, run_measured, run_operation
from benchmarks.compare.sets import ImageSet
from benchmarks.machine import describe_machine
from snakesfm.blocks import choose_blocks, tile_names
from snakesfm.job_logs import find_cost
from snakesfm.pipeline import stages_between

FEATURES = 5000
EXTRACT = stages_between("index_images", "select_pairs")
MATCH = ("match_pairs", "calibrate_cameras", "estimate_two_view")
MAP = stages_between("build_view_graph", "adjust_bundle")
GROUPS = {"extract": EXTRACT, "match": MATCH, "map": MAP}
AFTER = ("export_model", "evaluate_model", "render_report")
STARTED = re.compile(r"^(\d{4}-\d\d-\d\dT\S+) \w+ (?!done in )", re.M)


def snakesfm(
    image_set: ImageSet,
    folder: Path,
    seed: int,
    threads: int,
    limit_s: float,
    options: Iterable[str] = (),
    target: str = "all",
) -> dict[str, Cost]:
    """The workflow as users run it, into folder/out/SET; what it cost in all and per group of stages.

    ``options`` are more items for ``--config``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    config = [f"images={image_set.images}", f"reference={image_set.reference}", "output=out"]
    config += [f"scene={image_set.name}", f"seed={seed}", *options]
    if image_set.known:
        config.append(f"cameras={image_set.reference}")
    command = [sys.executable, "-m", "snakemake", target, "--snakefile", str(ROOT / "Snakefile")]
    command += ["--profile", str(ROOT / "profiles" / "local"), "--cores", str(threads), "--config", *config]
    whole = run_measured(command, folder, folder / f"{Path(target).stem}.log", limit_s)
    return {**stage_costs(folder / "out" / image_set.name / "logs", whole), "total": whole}


def stage_costs(logs: Path, whole: Cost) -> dict[str, Cost]:
    """Cost of extract, match and map, from the last start and end in each job's log.

    The wall clock of a group runs from the end of the group before it to the end of its own last job, so
    that what Snakemake does between jobs is counted. Memory is the largest job's.
    """
    jobs = {path: path.read_text("utf-8") for path in logs.glob("*/*.log")}
    costs: dict[str, Cost] = {}
    since = min(_clock(found[-1]) for text in jobs.values() if (found := STARTED.findall(text)))
    for name, stages in GROUPS.items():
        ends = [
            found
            for path, text in jobs.items()
            if path.parent.name in stages and (found := find_cost(text))
        ]
        until = max((_clock(found["clock"]) for found in ends), default=since)
        cpu_seconds = sum(float(found["cpu"]) for found in ends)
        peak_mib = max((float(found["mb"]) for found in ends), default=0.0)
        costs[name] = Cost(round(until - since, 2), round(cpu_seconds, 2), peak_mib, whole.others)
        since = until
    return costs


def job_counts(images: int) -> dict[str, int]:
    """How many jobs each group of stages has with default options, and how many come ``after`` the model.

    No group has jobs that describe images: these run beyond 1,000 images only.
    """
    blocks = choose_blocks(images)
    tiles = len(tile_names(blocks))
    jobs = {"extract_features": blocks, "match_pairs": tiles, "estimate_two_view": tiles}
    jobs |= {"learn_vocabulary": 0, "describe_images": 0}
    groups = {**GROUPS, "after": AFTER}
    return {name: sum(jobs.get(stage, 1) for stage in stages) for name, stages in groups.items()}


def _clock(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def colmap_front_end(image_set: ImageSet, folder: Path, threads: int, limit_s: float) -> dict[str, Cost]:
    """COLMAP's own features and matches of all pairs in folder/database.db, and the cost of both.

    They are made once, and again where the machine, the version of pycolmap or what they start from is
    another one.
    """
    record = folder / "cost.json"
    inputs = inputs_of(image_set, describe_machine(["pycolmap"]), FEATURES, threads)
    stored = json.loads(record.read_text("utf-8")) if record.is_file() else {}
    if stored.get("inputs") == inputs:
        return {name: Cost(**cost) for name, cost in stored["costs"].items()}
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    database = str(folder / "database.db")
    extraction = {
        "images": str(image_set.images),
        "database": database,
        "cameras": image_set.camera_groups(),
        "features": FEATURES,
        "threads": threads,
    }
    matching = {"database": database, "threads": threads}
    costs = {
        "extract": run_operation("extract", extraction, folder / "extract.log", limit_s),
        "match": run_operation("match", matching, folder / "match.log", limit_s),
    }
    content = {"inputs": inputs, "costs": {name: asdict(cost) for name, cost in costs.items()}}
    record.write_text(json.dumps(content), "utf-8")
    return costs


def colmap_map(
    operation: str,
    image_set: ImageSet,
    database: Path,
    folder: Path,
    calibrate: bool,
    seed: int,
    threads: int,
    limit_s: float,
) -> Cost:
    """COLMAP's mapper ``map_incremental`` or ``map_global`` on a copy of a database, into folder/model."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    copy = folder / "database.db"
    shutil.copyfile(database, copy)
    arguments = {
        "database": str(copy),
        "images": str(image_set.images),
        "output": str(folder),
        "fixed": image_set.known,
        "seed": seed,
        "threads": threads,
    }
    if operation == "map_global":
        arguments["calibrate"] = calibrate
    try:
        return run_operation(operation, arguments, folder / "map.log", limit_s)
    finally:
        copy.unlink()


def openmvg(image_set: ImageSet, folder: Path, seed: int, threads: int, limit_s: float) -> Cost:
    """OpenMVG's global engine with its own front-end, into folder/model."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    arguments = {
        "images": str(image_set.images),
        "output": str(folder),
        "intrinsics": image_set.pinhole(),
        "seed": seed,
        "threads": threads,
    }
    return run_operation("openmvg", arguments, folder / "openmvg.log", limit_s)
