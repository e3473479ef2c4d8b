"""Stage build_tracks: inlier matches of the kept edges to tracks."""

from typing import TYPE_CHECKING

import numpy as np

from snakesfm.artifacts.gather import gather_image_columns, gather_inlier_matches
from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.mapping import CameraRotations, TrackTable
from snakesfm.artifacts.pairs import ViewGraph
from snakesfm.errors import SceneError
from snakesfm.stages.job import StageJob
from snakesfm.tracks.build import build_tracks

if TYPE_CHECKING:
    from snakesfm.config.build_tracks import BuildTracksOptions


def run(job: StageJob) -> None:
    """Join the matches of edges that every filter kept, between images that have a rotation.

    Raises
    ------
    SceneError : no track is long enough.
    """
    options: BuildTracksOptions = job.options
    index = ImageIndex.read(job.path("index"))
    graph = ViewGraph.read(job.path("graph"))
    rotations = CameraRotations.read(job.path("rotations"))
    registered = np.isfinite(rotations.rotations[:, 0, 0])
    kept = (graph.labels == 0) & (rotations.labels == 0) & registered[graph.pairs].all(axis=1)
    keypoints, colors = gather_image_columns(job.paths("features"), len(index.names), "keypoints", "colors")
    pairs, offsets, matches = gather_inlier_matches(job.paths("geometries"), graph.pairs[kept])
    tracks = build_tracks(
        keypoints,
        pairs,
        offsets,
        matches,
        min_length=min(options.min_length, max(2, int(registered.sum()))),
        merge_radius_px=options.merge_radius_px,
        split=options.split_conflicts,
    )
    count = len(tracks.offsets) - 1
    if count == 0:
        raise SceneError(
            f"Scene '{job.scene}': no point is seen in {options.min_length} images along the "
            f"{len(pairs)} kept image pairs: add images with more overlap or lower build_tracks.min_length."
        )
    lengths = np.diff(tracks.offsets)
    print(
        f"{count} tracks of {lengths.mean():.2f} images on average from {len(matches)} matches; "
        f"{tracks.conflicts} components saw an image twice"
    )
    base = np.r_[0, np.cumsum([len(k) for k in keypoints])]
    rows = base[tracks.image_ids] + tracks.keypoint_ids
    TrackTable(
        offsets=tracks.offsets,
        image_ids=tracks.image_ids,
        keypoint_ids=tracks.keypoint_ids,
        part_ids=tracks.part_ids,
        keypoints=np.concatenate(keypoints)[rows],
        colors=np.concatenate(colors)[rows],
    ).write(job.output, job.header)
