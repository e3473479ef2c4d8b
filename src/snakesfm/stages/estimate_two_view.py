"""Stage estimate_two_view: matches of a tile become relative poses with inliers."""

import hashlib
import json
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.gather import gather_keypoints
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.pairs import KINDS, REJECTIONS, PairMatches, TwoViewGeometries
from snakesfm.geometry.camera import Camera, cameras_from_columns
from snakesfm.geometry.detector_pixels import (
    detector_scales,
    detector_sizes,
    reduce_cameras,
    reduce_keypoints,
)
from snakesfm.grouping import join_parts
from snakesfm.matching.overlays import cover_images, find_moving_matches
from snakesfm.stages.job import StageJob
from snakesfm.two_view.correspondences import first_rows_at_place, unify_matches
from snakesfm.two_view.estimate import TwoViewEstimate, estimate_two_view_geometry

if TYPE_CHECKING:
    from snakesfm.config.estimate_two_view import EstimateTwoViewOptions

Row = dict[str, Any]


REUSES_FORMER = True


def run(job: StageJob) -> None:
    """Estimate every pair of the tile whose inputs have changed, and write all of them.

    Raises
    ------
    ArtifactError : an image of a pair is in no features file.
    """
    options: EstimateTwoViewOptions = job.options
    index = ImageIndex.read(job.path("index"))
    cameras = CalibratedCameras.read(job.path("cameras"))
    of_camera = reduce_cameras(cameras_from_columns(*cameras.camera_columns), job.settings)
    matches = PairMatches.read(job.path("matches"))
    images = set(matches.pairs.ravel().tolist())
    found, image_digests = gather_keypoints(job.paths("features"), images, index.names)
    scales = detector_scales(index.sizes, job.settings)
    keypoints = {image: reduce_keypoints(points, scales[image]) for image, points in found.items()}
    places = {image: first_rows_at_place(points) for image, points in keypoints.items()}
    pairs: list[tuple[int, int]] = [(int(i), int(j)) for i, j in matches.pairs]
    cameras_of = [(of_camera[index.camera_ids[i]], of_camera[index.camera_ids[j]]) for i, j in pairs]
    seeds = [job.seed_for(str(index.names[i]), str(index.names[j])) for i, j in pairs]
    sizes = detector_sizes(index.sizes, job.settings)
    covered = cover_images(cameras.overlay_cells)
    used = []
    for k, (i, j) in enumerate(pairs):
        best = _best_first(matches, k)
        first, second = keypoints[i][best[:, 0]], keypoints[j][best[:, 1]]
        used.append(best[find_moving_matches(covered, sizes[[i, j]], first, second)])
    digests = [
        _digest(used[k], (image_digests[i], image_digests[j]), cameras_of[k], options, seeds[k])
        for k, (i, j) in enumerate(pairs)
    ]
    former = job.take_over(digests, _read_former)
    progress = job.progress(len(pairs), "pairs")
    rows: list[Row] = []
    for k, (i, j) in enumerate(pairs):
        row = former.get(k)
        if row is None:
            estimate = estimate_two_view_geometry(
                keypoints[i],
                keypoints[j],
                unify_matches(places[i], places[j], used[k]),
                *cameras_of[k],
                options,
                seeds[k],
            )
            row = _to_row(estimate)
        rows.append(row | {"digests": digests[k]})
        progress.step()
    _assemble(matches.pairs, rows).write(job.output, job.header)
    print(_summary(rows, len(former)), flush=True)


def _best_first(matches: PairMatches, pair: int) -> Array:
    """The matches (M,2) of a pair by falling confidence; in their order where that is equal."""
    rows = slice(matches.offsets[pair], matches.offsets[pair + 1])
    ordered: Array = matches.matches[rows][np.argsort(-matches.scores[rows], kind="stable")]
    return ordered


def _digest(
    matches: Array,
    image_digests: tuple[str, str],
    cameras: tuple[Camera, Camera],
    options: "EstimateTwoViewOptions",
    seed: int,
) -> str:
    """Digest of all that a pair's result depends on; cameras in detector pixels tell the images' scales."""
    named = {
        "images": image_digests,
        # the source of a focal length does not change the geometry
        "cameras": [(c.model, c.width, c.height, c.params) for c in cameras],
        "options": options.canonical_json(),
        "stage_version": options.stage_version,
        "seed": seed,
    }
    text = json.dumps(named, sort_keys=True).encode()
    return hashlib.sha256(text + np.ascontiguousarray(matches, dtype="<i4").tobytes()).hexdigest()


def _to_row(estimate: TwoViewEstimate) -> Row:
    return {
        "rotations": estimate.rotation,
        "translations": estimate.translation,
        "covariances": estimate.covariance,
        "kinds": KINDS.index(estimate.kind),
        "rejections": REJECTIONS.index(estimate.rejection),
        "match_counts": estimate.match_count,
        "inlier_counts": len(estimate.inliers),
        "inlier_ratios": estimate.inlier_ratio,
        "triangulation_angles_deg": estimate.triangulation_angle_deg,
        "inliers": estimate.inliers,
    }


COLUMNS = {column.name for column in fields(TwoViewGeometries)} - {"pairs", "digests", "offsets", "inliers"}


def _read_former(path: Path, wanted: set[str]) -> dict[str, Row]:
    """The wanted results of an earlier run by their digest; nothing where it cannot be read."""
    former = TwoViewGeometries.read_former(path)
    if former is None:
        return {}
    rows: dict[str, Row] = {}
    for k, digest in enumerate(former.digests):
        if digest not in wanted:
            continue
        row: Row = {name: getattr(former, name)[k] for name in COLUMNS}
        row["inliers"] = former.inliers[former.offsets[k] : former.offsets[k + 1]]
        rows[str(digest)] = row
    return rows


def _assemble(pairs: Array, rows: list[Row]) -> TwoViewGeometries:
    offsets, (inliers,) = join_parts([[row["inliers"]] for row in rows], [np.zeros((0, 2), np.int32)])
    return TwoViewGeometries(
        pairs=pairs,
        digests=np.array([row["digests"] for row in rows], dtype=object),
        offsets=offsets,
        inliers=inliers,
        **{name: np.array([row[name] for row in rows]) for name in COLUMNS},
    )


def _summary(rows: list[Row], reused: int) -> str:
    reasons = Counter(REJECTIONS[int(row["rejections"])] for row in rows)
    kinds = Counter(KINDS[int(row["kinds"])] for row in rows if int(row["rejections"]) == 0)
    accepted = reasons.pop("", 0)
    parts = [f"{accepted} of {len(rows)} pairs accepted"]
    parts += [f"{kinds[kind]} {kind}" for kind in KINDS[1:] if kinds[kind]]
    parts += [f"{reasons[reason]} {reason}" for reason in REJECTIONS if reasons.get(reason)]
    if reused:
        parts.append(f"{reused} unchanged and taken over")
    return "estimate_two_view: " + ", ".join(parts)
