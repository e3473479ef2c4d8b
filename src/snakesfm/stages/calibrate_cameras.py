"""Stage calibrate_cameras: unknown focal lengths from the matches."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.gather import gather_keypoints
from snakesfm.artifacts.images import CalibratedCameras, ImageIndex
from snakesfm.artifacts.mapping import Reconstruction
from snakesfm.artifacts.pairs import PairMatches
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import Camera, cameras_from_columns, cameras_to_columns
from snakesfm.geometry.detector_pixels import (
    detector_scales,
    detector_sizes,
    reduce_cameras,
    reduce_keypoints,
    restore_cameras,
)
from snakesfm.grouping import offsets_of
from snakesfm.matching.overlays import cover_images, find_moving_matches, find_overlay_cells
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.calibrate_cameras import CalibrateCamerasOptions

Covered = Mapping[tuple[int, int], Array]

GIVEN_SIGMA = 0.0
# a model of fewer hardly tells focal lengths and distortion apart
LEAST_IMAGES = 5
# matches of images taken from one place, as of bursts and slow video, move less in the median: such pairs
# match best and tell no focal length
MOVED_PX = 3.0
# more pairs show no other overlay, and cost time
OVERLAY_PAIRS = 3000
OVERLAY = (
    "{percent:.1f} % of the image area is the same in all images of one size (a time stamp, a logo, part "
    "of the vehicle, a fixed background?): matches that do not move there are left out. If this is part "
    "of the scene, set calibrate_cameras.overlay_share: 0."
)


def run(job: StageJob) -> None:
    """Estimate the focal lengths that are not given, and find what all images show at one place.

    Cameras that are given pass unchanged.

    Raises
    ------
    ArtifactError : an image whose matches are read is in no features file.
    """
    options: CalibrateCamerasOptions = job.options
    index = ImageIndex.read(job.path("index"))
    cameras = cameras_from_columns(
        index.camera_models, index.camera_sizes, index.camera_params, index.camera_sources
    )
    given = np.array([camera.source == "given" for camera in cameras], dtype=bool)
    sigmas = np.where(given, GIVEN_SIGMA, np.nan)
    counts = np.zeros(len(cameras), dtype=np.int32)
    matched = _MatchedImages(job, index)
    cells = np.zeros((0, 4), dtype=np.int32)
    if options.overlay_share:
        cells = find_overlay_cells(matched.of_one_size(OVERLAY_PAIRS), options.overlay_share)
    covered = cover_images(cells)
    if options.estimate_focals and not given.all():
        cameras, sigmas, counts = _calibrate(job, index, cameras, matched, covered)
        estimated = _artifact(cameras, sigmas, counts, cells, [])
        cameras, sigmas = _revised(job, index, cameras, estimated, matched)
    warnings = [OVERLAY.format(percent=100 * grid.mean()) for grid in covered.values()]
    _artifact(cameras, sigmas, counts, cells, warnings).write(job.output, job.header)
    for line in warnings:
        print(f"warning: {line}", flush=True)
    print(_summary(cameras), flush=True)


def _calibrate(
    job: StageJob,
    index: ImageIndex,
    cameras: list[Camera],
    matched: "_MatchedImages",
    covered: Covered,
) -> tuple[list[Camera], Array, Array]:
    # not needed where all cameras are given
    from snakesfm.calibration.focal import MatchedPair, calibrate_focals, choose_pairs

    options: CalibrateCamerasOptions = job.options
    given = np.array([camera.source == "given" for camera in cameras], dtype=bool)
    counts = matched.counts.copy()

    def choose(per_camera: int) -> Array:
        return choose_pairs(
            matched.pairs, counts, index.camera_ids, ~given, per_camera, options.min_matches
        )

    chosen, looked_at = choose(options.pairs_per_camera), options.pairs_per_camera
    while len(still := matched.still_pairs(chosen, covered, MOVED_PX)):
        counts[still] = 0
        # where most pairs are such, their number is that of the images
        looked_at *= 2
        counts[matched.still_pairs(choose(looked_at), covered, MOVED_PX)] = 0
        chosen = choose(options.pairs_per_camera)
    progress = job.progress(len(chosen), "pairs")
    pairs: dict[int, MatchedPair] = {}
    for row, first, second in matched.read_moving(chosen, covered):
        i, j = matched.pairs[row].tolist()
        pairs[row] = MatchedPair(
            int(index.camera_ids[i]),
            int(index.camera_ids[j]),
            first,
            second,
            job.seed_for(str(index.names[i]), str(index.names[j])),
        )
        progress.step()
    # in the order of the pairs, not of the files
    ordered = [pairs[row] for row in sorted(pairs)]
    result = calibrate_focals(ordered, reduce_cameras(cameras, job.settings), options, job.threads)
    return restore_cameras(result.cameras, cameras, job.settings), result.sigmas, result.pair_counts


def _revised(
    job: StageJob,
    index: ImageIndex,
    cameras: list[Camera],
    estimated: CalibratedCameras,
    matched: "_MatchedImages",
) -> tuple[list[Camera], Array]:
    """The cameras as a provisional model has them, if its focal lengths are others, and their deviations.

    Focal lengths that EXIF tells stay: a quick model knows them no better.

    Parameters
    ----------
    cameras, estimated : the cameras so far, and the same as an artifact.
    """
    # most scenes need none of it
    from snakesfm.bundle.keypoint_refinement import most_share_a_camera
    from snakesfm.calibration.focal import choose_pairs
    from snakesfm.stages.provisional_model import make_provisional_model

    options: CalibrateCamerasOptions = job.options
    sigmas = estimated.focal_sigma
    wanted = options.provisional_model
    if wanted == "auto":
        wanted = not most_share_a_camera(index.camera_ids)
    # those of no sigma have a default
    doubtful = ~(sigmas <= options.exif_sigma)
    if not wanted or np.count_nonzero(doubtful[index.camera_ids]) < LEAST_IMAGES:
        return cameras, sigmas
    chosen = choose_pairs(
        matched.pairs,
        matched.counts,
        np.arange(len(index.names)),
        doubtful[index.camera_ids],
        options.provisional_pairs,
        options.min_matches,
    )
    try:
        model = make_provisional_model(job, estimated, matched.deal(chosen, job.threads))
    except SceneError as error:
        print(f"no provisional model: {error}", flush=True)
        return cameras, sigmas
    adjusted = cameras_from_columns(model.camera_models, model.camera_sizes, model.camera_params)
    rows = np.flatnonzero(doubtful & _told(index, model, adjusted, options)).tolist()
    changes = [abs(math.log(adjusted[row].focal_px / cameras[row].focal_px)) for row in rows]
    deviations = np.where(np.isnan(sigmas), options.default_sigma, sigmas)[rows]
    change = float(np.median(changes / deviations)) if rows else 0.0
    used = change > options.min_revision_sigmas
    print(
        f"the provisional model changes {len(rows)} focal lengths by {change:.2f} standard deviations in "
        f"the median: its cameras are {'used' if used else 'not needed'}",
        flush=True,
    )
    if not used:
        return cameras, sigmas
    cameras, sigmas = cameras.copy(), sigmas.copy()
    # what was claimed is refuted
    sigmas[rows] = np.nan
    for row in rows:
        cameras[row] = replace(adjusted[row], source="estimated")
    return cameras, sigmas


def _told(
    index: ImageIndex,
    model: Reconstruction,
    adjusted: list[Camera],
    options: "CalibrateCamerasOptions",
) -> Array:
    """Which cameras (C,) bool a model of enough images has with a plausible focal length."""
    sizes = np.bincount(model.models[model.models >= 0])
    told = np.zeros(len(adjusted), dtype=bool)
    told[index.camera_ids[(model.models >= 0) & (sizes[model.models] >= LEAST_IMAGES)]] = True
    ratios = np.array([camera.focal_px / max(camera.width, camera.height) for camera in adjusted])
    plausible = (ratios > options.min_focal_ratio) & (ratios < options.max_focal_ratio)
    return np.asarray(told & plausible & (model.camera_resets == ""))


def _artifact(
    cameras: list[Camera], sigmas: Array, counts: Array, cells: Array, warnings: list[str]
) -> CalibratedCameras:
    models, sizes, params, sources = cameras_to_columns(cameras)
    return CalibratedCameras(
        np.array(models, dtype=object),
        sizes,
        params,
        np.array(sources, dtype=object),
        sigmas,
        counts,
        cells,
        np.array(warnings, dtype=object),
    )


class _MatchedImages:
    """The matches of all pairs, read where they are asked for; the keypoints that these need are kept.

    Attributes
    ----------
    pairs, counts : rows (i, j) of all pairs (P,2), sorted, and their matches (P,).
    sizes : (N,2) width and height of the images in detector pixels.
    """

    def __init__(self, job: StageJob, index: ImageIndex) -> None:
        table, self._places = _read_counts(job.paths("matches"))
        self.pairs, self.counts = table[:, :2], table[:, 2]
        self._features, self._names = job.paths("features"), index.names
        self._scales = detector_scales(index.sizes, job.settings)
        self.sizes = detector_sizes(index.sizes, job.settings)
        self._keypoints: dict[int, Array] = {}
        self._moved_px: dict[int, float] = {}

    def read(self, rows: Array) -> Iterator[tuple[int, Array, Array]]:
        """Some rows, file by file, and their matched keypoints (K,2) in detector pixels, best first."""
        wanted = set(self.pairs[rows].ravel().tolist()) - self._keypoints.keys()
        found, _ = gather_keypoints(self._features, wanted, self._names)
        for image, points in found.items():
            self._keypoints[image] = reduce_keypoints(points, self._scales[image])
        for row, matches, scores in self._parts(rows):
            i, j = self.pairs[row].tolist()
            # best first: the estimator draws from the first ones sooner
            best = matches[np.argsort(-scores, kind="stable")]
            yield row, self._keypoints[i][best[:, 0]], self._keypoints[j][best[:, 1]]

    def read_moving(self, rows: Array, covered: Covered) -> Iterator[tuple[int, Array, Array]]:
        """The same without the matches on overlays."""
        for row, first, second in self.read(rows):
            moving = find_moving_matches(covered, self.sizes[self.pairs[row]], first, second)
            yield row, first[moving], second[moving]

    def still_pairs(self, rows: Array, covered: Covered, least_px: float) -> Array:
        """Those of some rows whose matches move less in the median; each pair is looked at once."""
        looked_at = self._moved_px
        new = rows[[row not in looked_at for row in rows.tolist()]]
        for row, first, second in self.read_moving(new, covered):
            moved = np.linalg.norm(first - second, axis=1)
            looked_at[row] = float(np.median(moved)) if len(moved) else 0.0
        return rows[[looked_at[row] < least_px for row in rows.tolist()]]

    def deal(self, rows: Array, count: int) -> list[PairMatches]:
        """Some rows, ascending, in up to so many artifacts, none of them empty."""
        dealt = np.array_split(rows, min(count, len(rows))) if len(rows) else []
        return [self._select(part) for part in dealt]

    def _select(self, rows: Array) -> PairMatches:
        parts = {row: (matches, scores) for row, matches, scores in self._parts(rows)}
        matches, scores = zip(*(parts[row] for row in rows.tolist()), strict=True)
        return PairMatches(
            self.pairs[rows],
            np.full(len(rows), "", dtype=object),
            offsets_of([len(part) for part in scores]),
            np.concatenate(matches),
            np.concatenate(scores),
        )

    def _parts(self, rows: Array) -> Iterator[tuple[int, Array, Array]]:
        """Some rows, file by file, their matches (K,2) and scores (K,)."""
        by_file = sorted(rows.tolist(), key=self._places.__getitem__)
        for path, of_file in groupby(by_file, key=lambda row: self._places[row][0]):
            with PairMatches.open(path) as file:
                for row in of_file:
                    part = slice(*self._places[row][1:])
                    yield row, file["matches"][part], file["scores"][part]

    def of_one_size(self, most: int) -> Iterator[tuple[tuple[int, int], Array, Array]]:
        """Up to so many pairs of images of one size, evenly drawn: the size and the keypoints."""
        alike = np.flatnonzero((self.sizes[self.pairs[:, 0]] == self.sizes[self.pairs[:, 1]]).all(axis=1))
        drawn = alike[np.linspace(0, len(alike) - 1, most).astype(int)] if len(alike) > most else alike
        for row, first, second in self.read(drawn):
            width, height = self.sizes[self.pairs[row, 0]].tolist()
            yield (width, height), first, second


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
