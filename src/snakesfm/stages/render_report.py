"""render_report: one HTML page about a scene, from the artifacts of its stages."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import snakesfm
from snakesfm.arrays import Array
from snakesfm.artifacts import (
    CalibratedCameras,
    CameraCenters,
    CameraRotations,
    ImageIndex,
    Reconstruction,
    TrackTable,
    TriangulatedPoints,
    TwoViewGeometries,
    ViewGraph,
    read_header,
)
from snakesfm.artifacts.pairs import EDGE_LABELS, KINDS, REJECTIONS
from snakesfm.atomic import atomic_path
from snakesfm.geometry.camera import cameras_from_columns, observation_errors
from snakesfm.grouping import rows_of_each
from snakesfm.job_logs import stage_costs
from snakesfm.pipeline import STAGES
from snakesfm.reporting.page import Page, render_page
from snakesfm.reporting.plots import error_histogram, scene_map, view_axes
from snakesfm.reporting.registration import (
    ImageCounts,
    count_by_image,
    mean_by_image,
    reason_not_registered,
)
from snakesfm.reporting.tables import (
    PLACE_HEADS,
    ROUND_HEADS,
    bundle_rows,
    image_table,
    label_counts,
    metric_tables,
    place_rows,
)
from snakesfm.stages.job import StageJob
from snakesfm.tracks.merged import describe_lengths

TRACK_COLUMNS = ("offsets", "image_ids", "lengths_unmerged", "lengths_merged")


@dataclass(frozen=True)
class Pairs:
    """What the report needs of the two-view geometries of all tiles."""

    pairs: Array
    rejections: Array
    kinds: Array
    match_counts: Array
    inlier_counts: Array


def run(job: StageJob) -> None:
    """Write index.html."""
    index = ImageIndex.read(job.path("index"))
    calibrated = CalibratedCameras.read(job.path("cameras"))
    adjusted = Reconstruction.read(job.path("reconstruction"))
    model = adjusted.select_model(0)
    graph = ViewGraph.read(job.path("graph"))
    rotations = CameraRotations.read(job.path("rotations"))
    pairs = _read_pairs(job.paths("geometries"))
    tracks = _read_columns(TrackTable, job.path("tracks"), TRACK_COLUMNS)
    positioned = _read_columns(CameraCenters, job.path("centers"), ("components",))["components"] >= 0
    points = _read_columns(TriangulatedPoints, job.path("points"), ("offsets", "image_ids"))
    metrics = json.loads(job.path("metrics").read_text("utf-8"))
    summary = json.loads(job.path("summary").read_text("utf-8")) if "summary" in job.inputs else {}
    # no declared inputs: a lost log is no reason to run the job again
    logs = _logs_in_use(job.output.parents[1] / "logs", job.paths("geometries"))

    names = [str(name) for name in index.names]
    point_of = np.repeat(np.arange(len(model.points)), np.diff(model.offsets))
    cameras = cameras_from_columns(model.camera_models, model.camera_sizes, model.camera_params)
    errors = observation_errors(
        cameras,
        index.camera_ids,
        model.rotations,
        model.translations,
        model.points[point_of],
        model.image_ids,
        model.keypoints,
    )
    counts = _counts(adjusted.models, model, errors, pairs, graph, rotations, positioned, tracks, points)
    seconds = stage_costs(path.read_text("utf-8", errors="replace") for path in logs)
    heads, rows, note = image_table(names, counts, metrics.get("per_image", {}), job.options.max_images)
    registered = np.flatnonzero(counts.registered)
    page = Page(
        scene=job.scene,
        lead=_lead(metrics),
        software=f"snakesfm {snakesfm.__version__}",
        warnings=summary.get("warnings", []),
        maps=_maps(names, model, registered, index.orientations, summary.get("georeference")),
        stage_heads=["stage", "result", *(["seconds", "peak MB"] if seconds else [])],
        stages=_stage_rows(
            index, calibrated, pairs, graph, rotations, tracks, points, model, counts, seconds
        ),
        tables=_tables(pairs, rotations.labels, model, summary, metrics),
        histogram=error_histogram(errors),
        histogram_caption=f"Errors of {len(errors):,} observations; the last bar includes the largest 1 %.",
        missing=_missing(index, names, counts, pairs, graph.pairs, rotations.labels),
        refused=[[str(a), str(b)] for a, b in zip(index.refused_names, index.refused_reasons, strict=True)],
        image_heads=heads,
        images=rows,
        images_note=note,
        options=_options(job),
    )
    with atomic_path(job.output) as temporary:
        temporary.write_text(render_page(page), "utf-8")


def _counts(
    models: Array,
    model: Reconstruction,
    errors: Array,
    pairs: Pairs,
    graph: ViewGraph,
    rotations: CameraRotations,
    positioned: Array,
    tracks: Mapping[str, Array],
    points: Mapping[str, Array],
) -> ImageCounts:
    """What each stage kept of every image; ``models`` is the model (N,) that each is in.

    ``positioned`` (N,) bool says which have a centre.
    """
    count = len(models)
    return ImageCounts(
        pairs=count_by_image(pairs.pairs, count),
        accepted=count_by_image(pairs.pairs[pairs.rejections == 0], count),
        kept=count_by_image(graph.pairs[rotations.labels == 0], count),
        components=graph.components,
        rotated=np.asarray(np.isfinite(rotations.rotations).all(axis=(1, 2))),
        positioned=positioned,
        track_observations=count_by_image(tracks["image_ids"], count),
        point_observations=count_by_image(points["image_ids"], count),
        models=models,
        observations=count_by_image(model.image_ids, count),
        mean_error_px=mean_by_image(errors, model.image_ids, count),
    )


def _tables(
    pairs: Pairs,
    edge_labels: Array,
    model: Reconstruction,
    summary: Mapping[str, Any],
    metrics: Mapping[str, Any],
) -> list[tuple[str, list[str], Sequence[Sequence[Any]]]]:
    """Title, heads and rows of the tables between those of stages and of images."""
    outcomes = label_counts(pairs.rejections, ("accepted", *REJECTIONS[1:]))
    rounds = bundle_rows(model.round_names, model.round_counts, model.round_costs, model.round_errors_px)
    return [
        ("Pairs", ["outcome", "pairs"], outcomes),
        ("View graph", ["filter", "edges"], label_counts(edge_labels, EDGE_LABELS)),
        ("Bundle adjustment", ROUND_HEADS, rounds),
        ("Georeference", PLACE_HEADS, place_rows(summary)),
        *metric_tables(metrics),
    ]


def _logs_in_use(folder: Path, tile_files: Sequence[Path]) -> list[Path]:
    """The logs of jobs: those of blocks and tiles that a run with more blocks had are left out."""
    tiles = {path.stem for path in tile_files}
    parts = {"job", *tiles, *(block for tile in tiles for block in tile.split("-"))}
    return [path for path in folder.rglob("*.log") if path.stem in parts]


def _read_columns(kind: type[Any], path: Path, columns: Sequence[str]) -> dict[str, Array]:
    with kind.open(path) as file:
        return {column: file[column][()] for column in columns}


def _read_pairs(paths: Sequence[Path]) -> Pairs:
    columns = ("pairs", "rejections", "kinds", "match_counts", "inlier_counts")
    parts = [_read_columns(TwoViewGeometries, path, columns) for path in paths]
    return Pairs(*(np.concatenate([part[column] for part in parts]) for column in columns))


def _lead(metrics: Mapping[str, Any]) -> str:
    text = (
        f"{metrics['registered_images']:,} of {metrics['images']:,} images registered, "
        f"{metrics['points']:,} points"
    )
    if metrics.get("reprojection_error_px_mean") is not None:
        text += f", mean reprojection error {metrics['reprojection_error_px_mean']:.3f} px"
        text += f", mean track length {metrics['track_length_mean']:.2f}"
    return text + "."


def _maps(
    names: Sequence[str],
    model: Reconstruction,
    registered: Array,
    orientations: Array,
    place: Mapping[str, Any] | None,
) -> list[tuple[str, str]]:
    """Captions and pictures of the model, with north where it is known from the ``place`` on the earth."""
    if len(registered) == 0:
        return []
    rotations, translations = model.rotations[registered], model.translations[registered]
    if place:
        axes = np.array(place["rotation_from_adjustment"])
    else:
        axes = view_axes(rotations, translations, orientations[registered])
    content = ([names[row] for row in registered], rotations, translations, model.points, model.colors)
    views = {
        "From above, north at the top" if place else "From above": axes,
        "From the side": np.array([axes[0], axes[2], -axes[1]]),
    }
    maps = []
    for caption, view in views.items():
        picture, outside = scene_map(*content, view)
        far = "1 camera is" if outside == 1 else f"{outside:,} cameras are"
        maps.append((f"{caption}; {far} too far away to be shown" if outside else caption, picture))
    return maps


def _stage_rows(
    index: ImageIndex,
    calibrated: CalibratedCameras,
    pairs: Pairs,
    graph: ViewGraph,
    rotations: CameraRotations,
    tracks: Mapping[str, Array],
    points: Mapping[str, Array],
    model: Reconstruction,
    counts: ImageCounts,
    seconds: Mapping[str, tuple[float, float]],
) -> list[list[Any]]:
    accepted = pairs.rejections == 0
    kinds = Counter(pairs.kinds[accepted].tolist())
    kind_text = ", ".join(f"{kinds[k]:,} {KINDS[k].replace('_', ' ')}" for k in sorted(kinds))
    sizes = np.bincount(graph.components[graph.components >= 0])
    residuals = rotations.residuals_deg[(rotations.labels == 0) & np.isfinite(rotations.residuals_deg)]
    residual = f", median residual {np.median(residuals):.2f} deg" if len(residuals) else ""
    duplicates = int(np.sum(index.duplicate_of >= 0))
    results = {
        "index_images": f"{len(index.names):,} images of {len(index.camera_models):,} cameras; "
        f"{len(index.refused_names):,} files refused, {duplicates:,} duplicates",
        "calibrate_cameras": _describe_focals(calibrated),
        "match_pairs": f"{len(pairs.pairs):,} pairs matched, {int(pairs.match_counts.sum()):,} matches "
        "between distinct places",
        "estimate_two_view": f"{int(accepted.sum()):,} pairs accepted ({kind_text or 'none'}), "
        f"{int((~accepted).sum()):,} refused; {int(pairs.inlier_counts[accepted].sum()):,} inlier matches",
        "filter_view_graph": f"{int(np.sum(graph.labels == 0)):,} of {len(graph.labels):,} edges kept; "
        f"largest component {int(sizes[0]) if len(sizes) else 0:,} images",
        "average_rotations": f"{int(counts.rotated.sum()):,} images have a rotation{residual}",
        "average_translations": f"{int(counts.positioned.sum()):,} images have a position",
        "build_tracks": f"{len(tracks['offsets']) - 1:,} tracks, {len(tracks['image_ids']):,} keypoints",
        "triangulate_tracks": f"{len(points['offsets']) - 1:,} points, "
        f"{len(points['image_ids']):,} observations",
        "adjust_bundle": f"{int(counts.registered.sum()):,} images, {len(model.points):,} points, "
        f"{len(model.image_ids):,} observations",
    }
    if len(tracks["lengths_unmerged"]):
        results["merge_keypoints"] = (
            f"inlier matches before merging keypoints: {describe_lengths(tracks['lengths_unmerged'])}; "
            f"after merging: {describe_lengths(tracks['lengths_merged'])}"
        )
    rows = [[stage, results.get(stage, "")] for stage in STAGES if stage in results or stage in seconds]
    return [[*row, *seconds.get(row[0], (None, None))] for row in rows] if seconds else rows


def _describe_focals(cameras: CalibratedCameras) -> str:
    sources = Counter(cameras.sources.tolist())
    text = "focal lengths: " + ", ".join(f"{sources[source]:,} {source}" for source in sorted(sources))
    known = cameras.focal_sigma[np.isfinite(cameras.focal_sigma)]
    return text + (f"; median standard deviation {100 * np.median(known):.1f} %" if len(known) else "")


def _missing(
    index: ImageIndex,
    names: Sequence[str],
    counts: ImageCounts,
    pairs: Pairs,
    edges: Array,
    edge_labels: Array,
) -> list[list[str]]:
    rows = []
    rejections, labels = (dict(rows_of_each(np.ravel(found))) for found in (pairs.pairs, edges))
    nothing = np.zeros(0, np.int64)
    for image in np.flatnonzero(~counts.registered).tolist():
        # a pair stands at two places of the flat list
        refused = pairs.rejections[rejections.get(image, nothing) // 2]
        dropped = edge_labels[labels.get(image, nothing) // 2]
        first = int(index.duplicate_of[image])
        reason = reason_not_registered(
            image,
            counts,
            names[first] if first >= 0 else "",
            dict(label_counts(refused[refused > 0], REJECTIONS)),
            dict(label_counts(dropped[dropped > 0], EDGE_LABELS)),
        )
        rows.append([names[image], reason])
    return rows


def _options(job: StageJob) -> dict[str, str]:
    """The options that the artifacts say they were made with, by stage."""
    paths = [path for name in sorted(job.inputs) for path in job.paths(name)[:1]]
    headers = [read_header(path) for path in paths if path.suffix == ".h5"]
    options = {str(header["stage"]): str(header["options"]) for header in headers if "stage" in header}
    return {stage: options[stage] for stage in STAGES if stage in options}
