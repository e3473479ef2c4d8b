"""A model with exact truth as the artifacts of a scene, and the stages that export, evaluate and report it."""

import csv
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from plain_artifacts import write_plain_cameras, write_plain_index, write_plain_tracks

from snakesfm.artifacts import (
    CameraCenters,
    CameraRotations,
    Header,
    LocalFeatures,
    Reconstruction,
    TriangulatedPoints,
    TwoViewGeometries,
    ViewGraph,
    write_json,
)
from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.config.export_model import ExportModelOptions
from snakesfm.config.render_report import RenderReportOptions
from snakesfm.geometry.camera import Camera, cameras_to_columns
from snakesfm.job_logs import describe_cost
from snakesfm.stages import evaluate_model, export_model, render_report
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import SyntheticProblem

COUNT = 9
LOST = 8
OVERLAY = "5.0 % of the images of a size show the same."
FILES = (
    "sparse/0/cameras.bin",
    "sparse/0/images.bin",
    "sparse/0/points3D.bin",
    "sparse/0/cameras.txt",
    "sparse/0/images.txt",
    "sparse/0/points3D.txt",
    "points.ply",
    "transforms.json",
    "summary.json",
)
HEADER = Header("test", 1, "scene", '{"an": "option"}')
NAMES = sorted(f"day 1/ü{k}#<b>{{}}.jpg" for k in range(COUNT))
CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.02))


def write_index(
    folder: Path, orientations: np.ndarray | None = None, gps: np.ndarray | None = None
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_plain_index(
        folder / "index.h5",
        NAMES,
        [(640, 480)] * COUNT,
        [CAMERA, CAMERA],
        camera_ids=np.arange(COUNT) % 2,
        refused_names=["no <image>.jpg"],
        refused_reasons=["It is a text file."],
        warnings=["5 images have a camera each."],
        orientations=orientations,
        gps=gps,
    )
    return folder / "index.h5"


def write_cameras(folder: Path, focal_sigma: tuple[float, float] = (0.0, 0.0)) -> Path:
    write_plain_cameras(folder / "cameras.h5", [CAMERA, CAMERA], focal_sigma, [OVERLAY])
    return folder / "cameras.h5"


def write_reconstruction(
    folder: Path,
    problem: SyntheticProblem,
    lost: Iterable[int] = (LOST,),
    reset: str = "",
    offset: float = np.nan,
    second: Iterable[int] = (),
    spread: float = np.nan,
) -> Path:
    """The truth as a finished model, ``lost`` images not registered, those of a ``second`` model apart.

    Also what is wrong with the second camera.
    """
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    rotations[list(lost)], translations[list(lost)] = np.nan, np.nan
    keep = ~np.isin(problem.track_image_ids, list(lost))
    model_of = np.isin(np.arange(COUNT), list(second)).astype(np.int32)
    if model_of.any():
        # every other point is of the second model
        point_of = np.repeat(np.arange(len(problem.points)), np.diff(problem.track_offsets))
        keep &= model_of[problem.track_image_ids] == point_of % 2
    lengths = np.add.reduceat(keep.astype(int), problem.track_offsets[:-1])
    seen = lengths > 0
    models, sizes, params, _ = cameras_to_columns([CAMERA, CAMERA])
    count = int(seen.sum())
    Reconstruction(
        camera_models=models,
        camera_sizes=sizes,
        camera_params=params,
        camera_resets=["", reset],
        camera_offsets=np.array([np.nan, offset]),
        camera_spreads=np.array([np.nan, spread]),
        rotations=rotations,
        translations=translations,
        models=np.where(np.isin(np.arange(COUNT), list(lost)), -1, model_of),
        points=problem.points[seen],
        colors=np.arange(count * 3).reshape(-1, 3).astype(np.uint8),
        errors_px=np.linspace(0.1, 0.5, count),
        offsets=np.concatenate([[0], np.cumsum(lengths[seen])]),
        image_ids=problem.track_image_ids[keep],
        keypoint_ids=problem.track_keypoint_ids[keep],
        keypoints=problem.track_keypoints[keep],
        round_names=["10 px", "5 px"],
        round_costs=np.array([[9.0, 4.0], [4.0, 3.5]]),
        round_counts=np.array([[9, 300, 900], [8, 290, 850]]),
        round_errors_px=np.array([0.6, 0.4]),
    ).write(folder / "reconstruction.h5", HEADER)
    return folder / "reconstruction.h5"


def write_features(folder: Path, problem: SyntheticProblem) -> Path:
    """The keypoints a quarter of a pixel from where they were refined to, and one of no point in each image."""
    keypoints = [np.vstack([found + 0.25, [[7.0, 9.0]]]) for found in problem.keypoints]
    counts = [len(found) for found in keypoints]
    total = sum(counts)
    LocalFeatures(
        image_ids=np.arange(COUNT),
        names=NAMES,
        digests=["d"] * COUNT,
        sizes=np.tile([640, 480], (COUNT, 1)),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        keypoints=np.concatenate(keypoints).astype(np.float32),
        descriptors=np.zeros((total, 0), np.uint8),
        scores=np.ones(total, np.float32),
        scales=np.ones(total, np.float32),
        angles=np.zeros(total, np.float32),
        colors=np.zeros((total, 3), np.uint8),
    ).write(folder / "features.h5", HEADER)
    return folder / "features.h5"


def make_images(folder: Path) -> Path:
    for name in NAMES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 48), "red").save(folder / name)
    return folder


def export(
    tmp_path: Path,
    problem: SyntheticProblem,
    orientations: np.ndarray | None = None,
    lost: Iterable[int] = (LOST,),
    gps: np.ndarray | None = None,
    masks: Path | None = None,
    reset: str = "",
    offset: float = np.nan,
    second: Iterable[int] = (),
    intrinsics: str = "refine",
    spread: float = np.nan,
    **options: bool,
) -> Path:
    inputs = {
        "index": str(write_index(tmp_path, orientations, gps)),
        "cameras": str(write_cameras(tmp_path)),
        "features": [str(write_features(tmp_path, problem))],
        "reconstruction": str(write_reconstruction(tmp_path, problem, lost, reset, offset, second, spread)),
    }
    folder = tmp_path / "out" / "scene" / "export_model"
    images = tmp_path / "photos"
    if not images.exists():
        make_images(images)
    export_model.run(
        StageJob(
            "export_model",
            "scene",
            inputs,
            tuple(folder / file for file in FILES),
            ExportModelOptions(**options),
            {"images": str(images), "intrinsics": intrinsics} | ({"masks": str(masks)} if masks else {}),
        )
    )
    return folder


def gps_of(problem: SyntheticProblem, noise_m: float) -> np.ndarray:
    """Positions of a flight: the model turned about its x axis and a hundred times as large."""
    centers = -np.einsum("nji,nj->ni", problem.rotations, problem.translations) * 100.0
    places = centers @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    places += np.random.default_rng(1).normal(size=places.shape) * noise_m
    return pycolmap.GPSTransform().enu_to_ellipsoid(places, 47.0, 8.0, 500.0)


def evaluate(
    tmp_path: Path, problem: SyntheticProblem, reference: str, lost: Iterable[int] = (LOST,)
) -> tuple[dict, dict]:
    folder = tmp_path / "evaluate_model"
    inputs = {
        "index": str(write_index(tmp_path)),
        "reconstruction": str(write_reconstruction(tmp_path, problem, lost)),
    }
    evaluate_model.run(
        StageJob(
            "evaluate_model",
            "scene",
            inputs,
            (folder / "metrics.json", folder / "metrics.csv"),
            EvaluateModelOptions(),
            {"reference": reference},
        )
    )
    with (folder / "metrics.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1
    return json.loads((folder / "metrics.json").read_text("utf-8")), rows[0]


def write_former_stages(folder: Path, problem: SyntheticProblem) -> dict[str, object]:
    """What the report reads of the stages before: image LOST has only refused pairs."""
    pairs, edges = problem.pairs, len(problem.pairs)
    lost = (pairs == LOST).any(axis=1)
    TwoViewGeometries(
        pairs=pairs,
        digests=["0"] * edges,
        rotations=problem.edge_rotations,
        translations=problem.edge_translations,
        covariances=problem.edge_covariances,
        kinds=np.zeros(edges, np.int8),
        rejections=np.where(lost, 3, 0),
        match_counts=problem.edge_inlier_counts + 10,
        inlier_counts=problem.edge_inlier_counts,
        inlier_ratios=np.full(edges, 0.5),
        triangulation_angles_deg=problem.edge_angles_deg,
        offsets=problem.match_offsets,
        inliers=problem.matches,
    ).write(folder / "0-0.h5", HEADER)
    kept = ~lost
    ViewGraph(
        pairs=pairs[kept],
        rotations=problem.edge_rotations[kept],
        translations=problem.edge_translations[kept],
        covariances=problem.edge_covariances[kept],
        kinds=np.zeros(kept.sum(), np.int8),
        inlier_counts=problem.edge_inlier_counts[kept],
        triangulation_angles_deg=problem.edge_angles_deg[kept],
        labels=np.where(np.arange(kept.sum()) == 0, 2, 0),
        cycle_min_deg=np.ones(kept.sum()),
        cycle_median_deg=np.ones(kept.sum()),
        components=np.where(np.arange(COUNT) == LOST, 1, 0),
    ).write(folder / "graph.h5", HEADER)
    rotations = problem.rotations.copy()
    rotations[LOST] = np.nan
    CameraRotations(
        rotations=rotations,
        residuals_deg=np.full(kept.sum(), 0.25),
        labels=np.where(np.arange(kept.sum()) == 0, 2, 0),
        components=np.where(np.arange(COUNT) == LOST, -1, 0),
    ).write(folder / "rotations.h5", HEADER)
    CameraCenters(
        centers=np.where(np.arange(COUNT)[:, None] == LOST, np.nan, problem.centers),
        components=np.where(np.arange(COUNT) == LOST, -1, 0),
        edge_residuals_deg=np.zeros(kept.sum()),
        ray_residuals_deg=np.zeros(len(problem.track_image_ids)),
    ).write(folder / "centers.h5", HEADER)
    write_plain_tracks(folder / "tracks.h5", problem)
    TriangulatedPoints(
        points=problem.points,
        offsets=problem.track_offsets,
        image_ids=problem.track_image_ids,
        keypoint_ids=problem.track_keypoint_ids,
        keypoints=problem.track_keypoints,
        colors=np.zeros((len(problem.points), 3), np.uint8),
    ).write(folder / "points.h5", HEADER)
    log = folder / "logs" / "match_pairs" / "0-0.log"
    other = folder / "logs" / "build_view_graph" / "job.log"
    for path, stage, seconds in ((log, "match_pairs", 12.5), (other, "build_view_graph", 3.25)):
        path.parent.mkdir(parents=True)
        path.write_text(describe_cost(stage, 0.0, seconds, 12.0, 321.0) + "\n", "utf-8")
    write_cameras(folder, (0.02, np.nan))
    names = ("cameras", "graph", "rotations", "tracks", "centers", "points", "index", "reconstruction")
    inputs: dict[str, object] = {name: str(folder / f"{name}.h5") for name in names}
    # of a run with more blocks
    (log.parent / "2-3.log").write_text(describe_cost("match_pairs", 0.0, 70.0, 7.0, 9.0) + "\n", "utf-8")
    return {**inputs, "geometries": [str(folder / "0-0.h5")]}


def report(
    tmp_path: Path,
    problem: SyntheticProblem,
    reference: str,
    lost: Iterable[int] = (LOST,),
    summary: dict[str, object] | None = None,
    **options: int,
) -> str:
    evaluate(tmp_path, problem, reference, lost)
    inputs = write_former_stages(tmp_path, problem)
    inputs["metrics"] = str(tmp_path / "evaluate_model" / "metrics.json")
    write_json(tmp_path / "summary.json", summary or {"warnings": ["camera 1: look <here>"]})
    inputs["summary"] = str(tmp_path / "summary.json")
    output = tmp_path / "render_report" / "index.html"
    render_report.run(
        StageJob("render_report", "a <scene>", inputs, (output,), RenderReportOptions(**options))
    )
    return output.read_text("utf-8")
