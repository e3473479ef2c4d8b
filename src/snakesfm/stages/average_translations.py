"""Stage average_translations: camera centres from averaged rotations, the view graph and the tracks."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.mapping import CameraCenters, CameraRotations, TrackTable
from snakesfm.artifacts.pairs import KINDS, ViewGraph
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import Camera, cameras_from_columns, undistort
from snakesfm.stages.job import StageJob
from snakesfm.translation_averaging.average import DOUBTFUL_SHARE, PositioningSettings, position_components
from snakesfm.translation_averaging.averagers import (
    GlobalPositioning,
    ScaleChain,
    TranslationAverager,
    TranslationRecovery,
)
from snakesfm.translation_averaging.problem import (
    PositioningProblem,
    direction_sigmas,
    edge_directions,
    world_rays,
)
from snakesfm.translation_averaging.support import SupportLimits

if TYPE_CHECKING:
    from snakesfm.config.average_translations import AverageTranslationsOptions

DOUBTFUL = (
    "only {percent:.0f} % of the rays agree with the positions of {count} cameras: the model may be "
    "folded, as happens where parts of the scene look alike, or lack cameras; check it, or add images in "
    "between."
)
# average_rotations.min_component_images, where nobody says what it is
USUAL_COMPONENT_IMAGES = 5


def run(job: StageJob) -> None:
    """Position the images that have a rotation, each component in its own coordinate frame.

    A component of the rotations may fall into several, if nothing tells their relative size.

    Edges take part that rotation averaging kept and whose translation has a direction; rays of the tracks
    take part as far as ``rays_per_camera`` allows.

    Raises
    ------
    SceneError : fewer than two images get a centre.
    """
    options: AverageTranslationsOptions = job.options
    index = ImageIndex.read(job.path("index"))
    cameras = cameras_from_columns(*CalibratedCameras.read(job.path("cameras")).camera_columns)
    graph = ViewGraph.read(job.path("graph"))
    averaged = CameraRotations.read(job.path("rotations"))
    tracks = TrackTable.read(job.path("tracks"))
    problem, usable = _problem(index, cameras, graph, averaged, tracks)
    settings = positioning_settings(options, job.seed_for("positions"))
    least = int(job.settings.get("min_component_images", USUAL_COMPONENT_IMAGES))
    result = position_components(problem, averaged.components, settings, least)
    sizes = np.bincount(result.components[result.components >= 0])
    placed = int(sizes.sum())
    if placed < 2:
        raise SceneError(
            f"Scene '{job.scene}': no two images could be positioned from {len(problem.pairs)} image pairs "
            f"and {len(tracks.offsets) - 1} tracks: add images from different positions with more overlap, "
            "or mask borders and captions that all images share."
        )
    for count, agreeing in zip(sizes.tolist(), result.agreeing, strict=True):
        if agreeing < DOUBTFUL_SHARE:
            job.warn(DOUBTFUL.format(percent=100 * agreeing, count=count))
    edges_deg, rays_deg = np.full(len(graph.pairs), np.nan), np.degrees(result.ray_residuals_rad)
    edges_deg[usable] = np.degrees(result.edge_residuals_rad)
    turned = int(np.isfinite(averaged.rotations[:, 0, 0]).sum())
    frames = f" in frames of {', '.join(map(str, sizes))} images" if len(sizes) > 1 else ""
    print(
        f"{placed} of {turned} images with a rotation are positioned{frames}; median residuals: edges "
        f"{_median(edges_deg):.2f} deg, rays {_median(rays_deg):.2f} deg"
    )
    CameraCenters(
        centers=result.centers,
        components=result.components,
        edge_residuals_deg=edges_deg,
        ray_residuals_deg=rays_deg,
    ).write(job.output, job.header)


def _problem(
    index: ImageIndex,
    cameras: Sequence[Camera],
    graph: ViewGraph,
    averaged: CameraRotations,
    tracks: TrackTable,
) -> tuple[PositioningProblem, Array]:
    """What images with a rotation tell of their positions, and which edges (E,) bool take part."""
    turned = np.isfinite(averaged.rotations[:, 0, 0])
    usable = (averaged.labels == 0) & turned[graph.pairs].all(axis=1)
    usable &= (graph.kinds != KINDS.index("rotation_only")) & np.isfinite(graph.translations[:, 0])
    # a part that a look-alike joined to a track is a landmark of its own: positioning cannot throw out rays
    by_part = np.argsort(tracks.part_ids, kind="stable")
    image_ids, keypoints = tracks.image_ids[by_part], tracks.keypoints[by_part]
    normalized = undistort(cameras, index.camera_ids, image_ids, keypoints)
    rows = turned[image_ids] & np.isfinite(normalized.sum(axis=1))
    pairs, images = graph.pairs[usable].astype(np.int64), image_ids[rows].astype(np.int64)
    problem = PositioningProblem(
        image_count=len(index.names),
        pairs=pairs,
        directions=edge_directions(averaged.rotations, pairs, graph.translations[usable]),
        sigmas_rad=direction_sigmas(graph.covariances[usable]),
        ray_images=images,
        ray_tracks=tracks.part_ids[by_part][rows].astype(np.int64),
        rays=world_rays(averaged.rotations, images, normalized[rows]),
    )
    return problem, usable


def positioning_settings(options: "AverageTranslationsOptions", seed: int) -> PositioningSettings:
    """What the options say."""
    return PositioningSettings(
        averager=translation_averager(options),
        limits=SupportLimits(
            sigma_rad=float(np.radians(options.ray_sigma_deg)),
            edge_rad=float(np.radians(options.max_edge_residual_deg)),
            min_support=options.min_support,
            min_ratio=options.min_support_ratio,
            max_relative_sigma=options.max_relative_sigma,
        ),
        refine=options.refine,
        rays_per_camera=options.rays_per_camera,
        restarts=options.restarts,
        restart=GlobalPositioning(options.positioning_loss_scale),
        seed=seed,
    )


def translation_averager(options: "AverageTranslationsOptions") -> TranslationAverager:
    """The averager that the options name, and what it falls back to with the same options."""
    recovery = TranslationRecovery(
        rays_per_camera=options.recovery_rays_per_camera,
        sigma=options.recovery_sigma,
        reject_outliers=options.reject_outliers,
        residual_rad=float(np.radians(options.max_edge_residual_deg)),
        mfas_projections=options.mfas_projections,
        mfas_weight=options.mfas_weight,
        chain=None,
    )
    chain = ScaleChain(
        sigma_rad=float(np.radians(options.ray_sigma_deg)),
        max_relative_sigma=options.max_relative_sigma,
        fallback=recovery,
    )
    if options.method == "translation_recovery":
        return replace(recovery, chain=chain)
    if options.method == "global_positioning":
        return GlobalPositioning(options.positioning_loss_scale)
    return chain


def _median(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else float("nan")
