"""Stage calibrate_cameras: unknown focal lengths from the matches."""

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.artifacts.gather import gather_keypoints
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.pairs import PairMatches
from snakesfm.geometry.camera import Camera, cameras_from_columns, cameras_to_columns
from snakesfm.geometry.detector_pixels import (
    detector_scales,
    reduce_cameras,
    reduce_keypoints,
    restore_cameras,
)
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions

Array = NDArray[Any]
GIVEN_SIGMA = 0.0


def run(job: StageJob) -> None:
    """Estimate the focal lengths that are not given; cameras that are given pass unchanged."""
    options: CalibrateCamerasOptions = job.options
    index = ImageIndex.read(job.path("index"))
    cameras = cameras_from_columns(
        index.camera_models, index.camera_sizes, index.camera_params, index.camera_sources
    )
    given = np.array([camera.source == "given" for camera in cameras], dtype=bool)
    sigmas = np.where(given, GIVEN_SIGMA, np.nan)
    counts = np.zeros(len(cameras), dtype=np.int32)
    if options.estimate_focals and not given.all():
        cameras, sigmas, counts = _calibrate(job, index, cameras, options)
    models, sizes, params, sources = cameras_to_columns(cameras)
    CalibratedCameras(
        np.array(models, dtype=object), sizes, params, np.array(sources, dtype=object), sigmas, counts
    ).write(job.output, job.header)
    print(_summary(cameras), flush=True)


def _calibrate(
    job: StageJob, index: ImageIndex, cameras: list[Camera], options: "CalibrateCamerasOptions"
) -> tuple[list[Camera], Array, Array]:
    # not needed where all cameras are given
    from snakesfm.calibration.focal import MatchedPair, calibrate_focals, choose_pairs

    given = np.array([camera.source == "given" for camera in cameras], dtype=bool)
    candidates, places = _read_counts(job.paths("matches"))
    chosen = choose_pairs(
        candidates[:, :2],
        candidates[:, 2],
        index.camera_ids,
        ~given,
        options.pairs_per_camera,
        options.min_matches,
    )
    found, _ = gather_keypoints(job.paths("features"), set(candidates[chosen, :2].ravel().tolist()))
    scales = detector_scales(index.sizes, job.settings)
    keypoints = {image: reduce_keypoints(points, scales[image]) for image, points in found.items()}
    progress = job.progress(len(chosen), "pairs")
    pairs: dict[int, MatchedPair] = {}
    by_file = sorted(chosen.tolist(), key=places.__getitem__)
    for path, rows in groupby(by_file, key=lambda row: places[row][0]):
        with PairMatches.open(path) as file:
            columns, scores = file["matches"], file["scores"]
            for row in rows:
                i, j = candidates[row, :2].tolist()
                progress.step()
                if i not in keypoints or j not in keypoints:
                    continue
                part = slice(*places[row][1:])
                # best first: the estimator draws from the first ones sooner
                order = np.argsort(-scores[part], kind="stable")
                matches = columns[part][order]
                pairs[row] = MatchedPair(
                    int(index.camera_ids[i]),
                    int(index.camera_ids[j]),
                    keypoints[i][matches[:, 0]],
                    keypoints[j][matches[:, 1]],
                    job.seed_for(str(index.names[i]), str(index.names[j])),
                )
    # in the order of the pairs, not of the files
    ordered = [pairs[row] for row in sorted(pairs)]
    result = calibrate_focals(ordered, reduce_cameras(cameras, job.settings), options, job.threads)
    return restore_cameras(result.cameras, cameras, job.settings), result.sigmas, result.pair_counts


def _read_counts(paths: Iterable[Path]) -> tuple[Array, list[tuple[Path, int, int]]]:
    """Rows (i, j, matches) of all pairs (P,3), sorted by i and j, and where the matches of each lie."""
    rows: list[tuple[int, int, int]] = []
    places: list[tuple[Path, int, int]] = []
    for path in paths:
        with PairMatches.open(path) as file:
            offsets = file["offsets"][()].tolist()
            for k, (i, j) in enumerate(file["pairs"][()].tolist()):
                rows.append((i, j, offsets[k + 1] - offsets[k]))
                places.append((path, offsets[k], offsets[k + 1]))
    order = sorted(range(len(rows)), key=rows.__getitem__)
    table = np.array([rows[k] for k in order], dtype=np.int64).reshape(-1, 3)
    return table, [places[k] for k in order]


def _summary(cameras: list[Camera]) -> str:
    sources = sorted({camera.source for camera in cameras})
    counts = ", ".join(f"{sum(c.source == s for c in cameras)} {s}" for s in sources)
    return f"calibrate_cameras: {len(cameras)} cameras, focal lengths {counts or 'none'}"
