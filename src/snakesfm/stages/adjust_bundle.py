"""Stage adjust_bundle: cameras, poses and points adjusted together."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.gather import gather_image_columns, gather_inlier_matches, gather_refused_pairs
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.mapping import CameraCenters, CameraRotations, Reconstruction, TriangulatedPoints
from snakesfm.artifacts.pairs import ViewGraph
from snakesfm.bundle.alignment import AlignmentSettings
from snakesfm.bundle.completion import correspondence_graph
from snakesfm.bundle.image_sources import ImageSource, open_image_sources
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.keypoint_refinement import most_share_a_camera
from snakesfm.bundle.model import (
    BundleModel,
    from_reconstruction,
    mean_point_errors,
    reprojection_errors,
    restrict_to,
    to_reconstruction,
)
from snakesfm.bundle.models import join_models, tied_images
from snakesfm.bundle.round_settings import RoundRecord, RoundSettings
from snakesfm.bundle.rounds import adjust_rounds
from snakesfm.bundle.wild_cameras import WildCause
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import cameras_from_columns, cameras_to_columns
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.detector_pixels import (
    detector_scales,
    reduce_all_keypoints,
    reduce_cameras,
    restore_cameras,
)
from snakesfm.geometry.poses import translation_of
from snakesfm.grouping import offsets_of
from snakesfm.stages.job import StageJob
from snakesfm.triangulation.tracks import mean_colors

if TYPE_CHECKING:
    from snakesfm.config.adjust_bundle import AdjustBundleOptions

SMALLEST_FURTHER_MODEL = 3
USUAL_ITERATIONS = 50
# of cameras that were reset, in a line of the log
MOST_NAMED = 20


def run(job: StageJob) -> None:
    """Adjust each component's model in rounds and write all of them, the one with most images first.

    Raises
    ------
    SceneError : fewer than two images are left, or one cannot be read now or is another than when it was
        indexed.
    """
    index = ImageIndex.read(job.path("index"))
    originals = cameras_from_columns(*CalibratedCameras.read(job.path("cameras")).camera_columns)
    rotations = CameraRotations.read(job.path("rotations")).rotations
    averaged = CameraCenters.read(job.path("centers"))
    poses = BundleModel(
        tuple(reduce_cameras(originals, job.settings)),
        index.camera_ids,
        rotations,
        translation_of(rotations, averaged.centers),
        points=np.zeros((0, 3)),
        offsets=np.zeros(1, np.int64),
        image_ids=np.zeros(0, np.int32),
        keypoint_ids=np.zeros(0, np.int32),
    )
    graph = ViewGraph.read(job.path("graph"))
    refused = gather_refused_pairs(job.paths("geometries") if job.options.complete_refused_pairs else [])
    cameras, taken = poses.cameras, np.zeros(len(index.names), dtype=bool)
    adjusted: list[tuple[BundleModel, np.ndarray]] = []
    records: list[RoundRecord] = []
    resets: dict[int, WildCause] = {}
    far: dict[int, float] = {}
    mixed: dict[int, float] = {}
    for component in range(int(averaged.components.max(initial=0)) + 1):
        mine = (averaged.components == component) & ~taken
        part = restrict_to(replace(poses, cameras=cameras), mine)
        least = SMALLEST_FURTHER_MODEL if component else 2
        if mine.sum() < least:
            if mine.any():
                print(
                    f"part {component + 1} is left out: {mine.sum()} of its images are in no other model, "
                    f"and a model needs {least}",
                    flush=True,
                )
            continue
        prefix = f"part {component + 1}, " if component else ""
        result, observed, rounds = _adjust(job, index, part, graph, refused, taken, prefix)
        records += rounds
        # intrinsics of a part that came apart must not reach the others
        if result.registered.sum() >= 2:
            resets |= rounds[-1].held
            far |= rounds[-1].far
            mixed |= rounds[-1].mixed
            cameras = result.cameras
            adjusted.append((result, observed))
            taken |= result.registered
    if not adjusted:
        raise SceneError(
            f"Scene '{job.scene}': bundle adjustment kept fewer than two images: the averaged poses do not "
            "fit the tracks; check the cameras' focal lengths, or lower adjust_bundle.min_observations. "
            "Photographs all taken from one position, as for a panorama, cannot be reconstructed; an "
            "object rotating in front of a fixed background needs masks=."
        )
    adjusted.sort(key=lambda found: -found[0].registered.sum())
    final = tuple(restore_cameras(cameras, originals, job.settings))
    joined, models = join_models([found for found, _ in adjusted], final)
    pixels = np.concatenate([observed for _, observed in adjusted])
    scales = detector_scales(index.sizes, job.settings).astype(np.float32)
    _write(job, joined, models, pixels * scales[joined.image_ids, None], records, resets, far, mixed)


def _adjust(
    job: StageJob,
    index: ImageIndex,
    poses: BundleModel,
    view_graph: ViewGraph,
    refused: np.ndarray,
    taken: np.ndarray,
    prefix: str,
) -> tuple[BundleModel, np.ndarray, list[RoundRecord]]:
    """One component's model adjusted, its observed keypoints (L,2) float32, and its rounds.

    All in detector pixels.

    Parameters
    ----------
    poses : cameras and poses to start from, without points.
    refused : (P,2) pairs beside the graph's edges whose matches complete tracks.
    taken : (N,) bool, images of other models: they stay where they are, and so do their cameras.
    prefix : goes before the names of the rounds.
    """
    options: AdjustBundleOptions = job.options
    pairs = np.concatenate(
        [_usable_pairs(view_graph, poses), refused[poses.registered[refused].all(axis=1)]]
    )
    pairs = pairs[~taken[pairs].any(axis=1)]
    images = tied_images(pairs, poses.registered)
    pairs = pairs[images[pairs].all(axis=1)]
    reconstruction = _start(job, index, poses, images)

    def read_graph() -> pycolmap.CorrespondenceGraph:
        counts = {image_id - 1: image.num_points2D() for image_id, image in reconstruction.images.items()}
        return correspondence_graph(counts, *gather_inlier_matches(job.paths("geometries"), pairs))

    refines = options.refine_keypoints
    if refines == "auto":
        refines = most_share_a_camera(index.camera_ids)
    sources = _image_sources(job, index) if refines else []
    reported: list[RoundRecord] = []

    def report(record: RoundRecord) -> None:
        reported.append(replace(record, name=prefix + record.name))
        _print_record(reported[-1])

    solving, settings = _solver_settings(job, poses, taken), _round_settings(job, poses)
    adjust_rounds(reconstruction, read_graph, poses.cameras, solving, settings, report, sources)
    result, observed = from_reconstruction(reconstruction, poses)
    return result, observed.astype(np.float32), reported


def _solver_settings(job: StageJob, poses: BundleModel, taken: np.ndarray) -> SolverSettings:
    """How each pass is solved: given cameras are held if they are to be, and those of other models."""
    options: AdjustBundleOptions = job.options
    fixed = job.settings.get("intrinsics", "fixed") == "fixed"
    held = {row for row, camera in enumerate(poses.cameras) if fixed and camera.source == "given"}
    held |= set(poses.camera_ids[taken].tolist())
    return SolverSettings(
        loss=options.loss,
        constant_cameras=frozenset(row + 1 for row in held),
        refine_focal=options.refine_focal,
        refine_distortion=options.refine_distortion,
        max_iterations=USUAL_ITERATIONS if options.max_iterations == "auto" else options.max_iterations,
        function_tolerance=options.function_tolerance,
    )


def _round_settings(job: StageJob, poses: BundleModel) -> RoundSettings:
    """What is done in and between the rounds; a model of two images has no point in three."""
    options: AdjustBundleOptions = job.options
    shared = options.model_dump(include=set(RoundSettings.__dataclass_fields__))
    shared["min_track_length"] = min(options.min_track_length, max(2, int(poses.registered.sum())))
    return RoundSettings(
        **shared,
        patient=options.max_iterations == "auto",
        widen_lenses=job.settings.get("camera_model") == "auto" and options.refine_distortion,
        seed=job.seed_for("bundle"),
    )


def _start(
    job: StageJob, index: ImageIndex, poses: BundleModel, images: np.ndarray
) -> pycolmap.Reconstruction:
    """The poses with the triangulated points that they see, and the ``images`` (N,) bool alone.

    It alone stays in memory.
    """
    start = TriangulatedPoints.read(job.path("points"))
    (keypoints,) = gather_image_columns(
        job.paths("features"),
        len(index.names),
        "keypoints",
        images=set(np.flatnonzero(images).tolist()),
    )
    reduced = reduce_all_keypoints(keypoints, index.sizes, job.settings)
    model = replace(
        poses,
        points=start.points,
        offsets=start.offsets,
        image_ids=start.image_ids,
        keypoint_ids=start.keypoint_ids,
    )
    return to_reconstruction(model, reduced, index.names.tolist(), images)


def _usable_pairs(graph: ViewGraph, poses: BundleModel) -> np.ndarray:
    """Edges that the filters kept, and all edges of images that averaging left out."""
    posed = poses.registered[graph.pairs].all(axis=1)
    usable: np.ndarray = graph.pairs[(graph.labels == 0) | ~posed]
    return usable


def _image_sources(job: StageJob, index: ImageIndex) -> list[ImageSource]:
    """The images in gray at the sizes at which keypoints are refined."""
    # not needed where keypoints are not refined
    from snakesfm.ingest.indexed import IndexedImages

    options: AdjustBundleOptions = job.options
    return open_image_sources(
        IndexedImages(index.names, index.sha256, job.settings["images"]).read,
        index.sizes,
        detector_scales(index.sizes, job.settings),
        options.refine_finenesses,
        AlignmentSettings(options.refine_radius_px, options.refine_min_correlation, threads=job.threads),
    )


def _print_record(record: RoundRecord) -> None:
    for cause in sorted(set(record.wild.values())):
        ids = sorted(camera_id for camera_id, what in record.wild.items() if what == cause)
        more = f" and {len(ids) - MOST_NAMED} more" if len(ids) > MOST_NAMED else ""
        named = ", ".join(str(camera_id) for camera_id in ids[:MOST_NAMED])
        print(f"{record.name}: cameras reset because their {cause} was implausible: {named}{more}")
    images, points, observations = record.counts
    print(
        f"{record.name}: cost {record.costs[0]:.1f} -> {record.costs[1]:.1f}, {images} images, "
        f"{points} points, {observations} observations, mean error {record.error_px:.3f} px",
        flush=True,
    )


def _write(
    job: StageJob,
    model: BundleModel,
    models: np.ndarray,
    observed: np.ndarray,
    records: list[RoundRecord],
    resets: dict[int, WildCause],
    far: dict[int, float],
    mixed: dict[int, float],
) -> None:
    (colors,) = gather_image_columns(job.paths("features"), len(model.camera_ids), "colors")
    base = offsets_of([len(k) for k in colors])
    rows = base[model.image_ids] + model.keypoint_ids
    camera_models, sizes, params, _ = cameras_to_columns(model.cameras)
    ids = range(1, len(model.cameras) + 1)
    Reconstruction(
        camera_models=np.array(camera_models),
        camera_sizes=sizes,
        camera_params=params,
        camera_resets=np.array([resets.get(camera_id, "") for camera_id in ids]),
        camera_offsets=np.array([far.get(camera_id, np.nan) for camera_id in ids]),
        camera_spreads=np.array([mixed.get(camera_id, np.nan) for camera_id in ids]),
        rotations=model.rotations,
        translations=model.translations,
        models=models,
        points=model.points,
        colors=mean_colors(np.concatenate(colors)[rows], model.offsets),
        errors_px=mean_point_errors(reprojection_errors(model, observed), model.offsets),
        offsets=model.offsets,
        image_ids=model.image_ids,
        keypoint_ids=model.keypoint_ids,
        keypoints=observed,
        round_names=np.array([record.name for record in records]),
        round_costs=np.array([record.costs for record in records]),
        round_counts=np.array([record.counts for record in records]),
        round_errors_px=np.array([record.error_px for record in records]),
    ).write(job.output, job.header)
