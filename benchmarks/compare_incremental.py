"""Times snakesfm against COLMAP's incremental pipeline, from images to model, in one run on one machine.

    python benchmarks/compare_incremental.py SCENE [--known] [--runs 3]

SCENE holds images/ and reference/ (a COLMAP model). COLMAP runs through pycolmap with its own defaults on
the processor: extraction, exhaustive matching, incremental mapping. With --known both get the reference's
intrinsics and keep them fixed (one camera for all images). The two take turns; medians are printed.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path

import cv2  # noqa: F401 - must be loaded before pycolmap, whose PNG library clashes otherwise
import pycolmap

from snakesfm.evaluation.colmap_model import model_poses, read_model
from snakesfm.evaluation.metrics import evaluate_poses

ROOT = Path(__file__).resolve().parents[1]
DEGREES = (1.0, 3.0, 5.0)


def run_colmap(scene: Path, folder: Path, known: bool, threads: int) -> tuple[float, Path]:
    """Seconds of COLMAP's own pipeline, and its largest model."""
    reader = pycolmap.ImageReaderOptions()
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = threads
    mode = pycolmap.CameraMode.AUTO
    if known:
        (camera,) = pycolmap.Reconstruction(str(scene / "reference")).cameras.values()
        reader.camera_model = camera.model.name
        reader.camera_params = ",".join(map(str, camera.params))
        mapping.ba_refine_focal_length = mapping.ba_refine_principal_point = False
        mapping.ba_refine_extra_params = False
        mode = pycolmap.CameraMode.SINGLE
    extraction = pycolmap.FeatureExtractionOptions()
    matching = pycolmap.FeatureMatchingOptions()
    for options in (extraction, matching):
        options.num_threads = threads
        options.use_gpu = False
    database = folder / "database.db"
    started = time.monotonic()
    pycolmap.extract_features(
        database,
        scene / "images",
        camera_mode=mode,
        reader_options=reader,
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(database, matching_options=matching)
    models = pycolmap.incremental_mapping(database, scene / "images", folder, mapping)
    seconds = time.monotonic() - started
    largest = max(models, key=lambda row: models[row].num_reg_images())
    return seconds, folder / str(largest)


def run_snakesfm(scene: Path, folder: Path, known: bool, threads: int) -> tuple[float, Path, float]:
    """Seconds of the workflow, its model, and the share of time in which no stage was at work."""
    config = [f"images={scene / 'images'}", "output=out", "scene=scene"]
    config += ["select_pairs={method: exhaustive}"]
    if known:
        config.append(f"cameras={scene / 'reference'}")
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")]
    command += ["--profile", str(ROOT / "profiles" / "local"), "--cores", str(threads), "--config", *config]
    started = time.monotonic()
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    seconds = time.monotonic() - started
    return seconds, folder / "out/scene/export_model/sparse/0", 1 - working(folder / "out/scene") / seconds


def working(output: Path) -> float:
    """Seconds in which at least one stage was at work, from the first and last lines of the jobs' logs."""
    spans = []
    for log in output.glob("logs/*/*.log"):
        clocks = re.findall(r"^(\d{4}-\d\d-\d\dT\S+) ", log.read_text("utf-8"), re.M)
        spans.append(tuple(datetime.fromisoformat(clock).timestamp() for clock in clocks[-2:]))
    total, end = 0.0, 0.0
    for start, stop in sorted(spans):
        total += max(0.0, stop - max(start, end))
        end = max(end, stop)
    return total


def accuracy(model: Path, scene: Path) -> list[float]:
    """Relative-pose AUC at 1, 3 and 5 degrees."""
    poses = model_poses(read_model(model))
    metrics = evaluate_poses(
        poses, model_poses(read_model(scene / "reference")), DEGREES, (5.0,), 1e-6
    ).metrics
    return [round(float(metrics[f"relative_pose_auc_{degrees:g}deg"]), 2) for degrees in DEGREES]


def main() -> None:
    """Run both in turns and print one JSON object."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--known", action="store_true", help="give both the reference's intrinsics, fixed")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    scene = arguments.scene.resolve()
    pycolmap.logging.minloglevel = 2
    times: dict[str, list[float]] = {"colmap": [], "snakesfm": [], "share": []}
    areas: dict[str, list[float]] = {}
    for _ in range(arguments.runs):
        with tempfile.TemporaryDirectory() as name:
            seconds, model = run_colmap(scene, Path(name), arguments.known, arguments.threads)
            times["colmap"].append(seconds)
            areas["colmap"] = accuracy(model, scene)
        with tempfile.TemporaryDirectory() as name:
            seconds, model, share = run_snakesfm(scene, Path(name), arguments.known, arguments.threads)
            times["snakesfm"].append(seconds)
            times["share"].append(share)
            areas["snakesfm"] = accuracy(model, scene)
    medians = {name: statistics.median(values) for name, values in times.items()}
    result = {
        "scene": scene.name,
        "threads": arguments.threads,
        "colmap_s": round(medians["colmap"], 1),
        "snakesfm_s": round(medians["snakesfm"], 1),
        "ratio": round(medians["snakesfm"] / medians["colmap"], 3),
        "start_up_share": round(medians["share"], 3),
        "relative_pose_auc": areas,
    }
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
