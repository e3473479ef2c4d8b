"""Stage build_tracks: inlier matches of the kept edges to tracks."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.gather import gather_image_columns, gather_inlier_matches
from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.mapping import CameraRotations, TrackTable
from snakesfm.artifacts.pairs import PairCoordinates, ViewGraph
from snakesfm.errors import SceneError
from snakesfm.geometry.detector_pixels import reduce_all_keypoints
from snakesfm.grouping import offsets_of
from snakesfm.stages.job import StageJob
from snakesfm.tracks.build import build_tracks
from snakesfm.tracks.merged import compare_track_lengths, describe_lengths

if TYPE_CHECKING:
    from snakesfm.config.build_tracks import BuildTracksOptions


def run(job: StageJob) -> None:
    """Join the matches of edges that rotation averaging kept, between images that have a rotation.

    Raises
    ------
    SceneError : no track is left.
    """
    options: BuildTracksOptions = job.options
    index = ImageIndex.read(job.path("index"))
    graph = ViewGraph.read(job.path("graph"))
    rotations = CameraRotations.read(job.path("rotations"))
    registered = np.isfinite(rotations.rotations[:, 0, 0])
    kept = (rotations.labels == 0) & registered[graph.pairs].all(axis=1)
    keypoints, colors = gather_image_columns(job.paths("features"), len(index.names), "keypoints", "colors")
    pairs, offsets, matches = gather_inlier_matches(job.paths("geometries"), graph.pairs[kept])
    min_length = min(options.min_length, max(2, int(registered.sum())))
    tracks = build_tracks(
        reduce_all_keypoints(keypoints, index.sizes, job.settings),
        pairs,
        offsets,
        matches,
        min_length=min_length,
        sparse_observations=options.sparse_observations,
        merge_radius_px=options.merge_radius_px,
    )
    count = len(tracks.offsets) - 1
    if count == 0:
        # where no track is long enough, every image keeps those of two images
        least = 2 if options.sparse_observations else min_length
        raise SceneError(
            f"Scene '{job.scene}': no point is seen in {least} images along the {len(pairs)} kept image "
            + _remedies(least, tracks.conflicts)
        )
    lengths = np.diff(tracks.offsets)
    print(
        f"{count} tracks of {lengths.mean():.2f} images on average from {len(matches)} matches; "
        f"{tracks.conflicts} components contained two points of one image"
    )
    nothing = np.zeros(0, np.int64)
    unmerged, merged = nothing, nothing
    if job.inputs.get("coordinates"):
        found = _read_coordinates(job.paths("coordinates"), pairs)
        unmerged, merged = compare_track_lengths(
            keypoints, pairs, offsets, matches, lambda i, j: found[i, j]
        )
        print(f"before merging keypoints: {describe_lengths(unmerged)}")
        print(f"after merging keypoints: {describe_lengths(merged)}, before any is left out")
    base = offsets_of([len(k) for k in keypoints])
    rows = base[tracks.image_ids] + tracks.keypoint_ids
    TrackTable(
        offsets=tracks.offsets,
        image_ids=tracks.image_ids,
        keypoint_ids=tracks.keypoint_ids,
        part_ids=tracks.part_ids,
        keypoints=np.concatenate(keypoints)[rows],
        colors=np.concatenate(colors)[rows],
        lengths_unmerged=unmerged,
        lengths_merged=merged,
    ).write(job.output, job.header)


def _remedies(least: int, dropped: int) -> str:
    """What to do where no track of ``least`` images is left and ``dropped`` ones saw an image twice."""
    remedies = ["add images with more overlap"]
    if least > 2:
        remedies.append("lower build_tracks.min_length")
    left_out = f" (left out as they see one image at two places: {dropped})" if dropped else ""
    return f"pairs{left_out}: {' or '.join(remedies)}."


def _read_coordinates(paths: Sequence[Path], pairs: Array) -> dict[tuple[int, int], Array]:
    """Coordinates (N,4) that were found without keypoints in each of the wanted pairs."""
    wanted = {(int(i), int(j)) for i, j in pairs}
    found = {}
    for path in paths:
        tile = PairCoordinates.read(path)
        for row, (i, j) in enumerate(tile.pairs.tolist()):
            if (i, j) in wanted:
                found[i, j] = tile.coordinates[tile.offsets[row] : tile.offsets[row + 1]]
    return found
