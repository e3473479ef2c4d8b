"""export_hloc: features, matches and the list of pairs in the files of hloc."""

from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts import ImageIndex, LocalFeatures, PairMatches, TwoViewGeometries
from snakesfm.artifacts.hloc import clashing_names, write_hloc_features, write_hloc_matches
from snakesfm.atomic import atomic_path
from snakesfm.errors import ConfigError
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.export_hloc import ExportHlocOptions

SPACES = (
    "Some image names contain spaces, at which hloc splits the lines of pairs.txt, so it cannot read this "
    "file: rename these images if hloc is to read it."
)

COLUMNS = ("keypoints", "descriptors", "scores", "scales", "angles")


def run(job: StageJob) -> None:
    """Write features.h5, matches.h5 and pairs.txt, each complete or not at all, a block or tile at a time.

    Pairs without a match are left out.
    """
    options: ExportHlocOptions = job.options
    names = [str(name) for name in ImageIndex.read(job.path("index")).names]
    clash = next(clashing_names(names), None)
    if clash is not None:
        raise ConfigError(
            f"hloc's files cannot distinguish the images '{clash[0]}' and '{clash[1]}': rename one of them."
        )
    features, matches, pairs = job.outputs
    places: dict[int, Array] = {}
    with atomic_path(features) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        for path in job.paths("features"):
            places |= _write_block(file, path, names)
    written: list[tuple[int, int]] = []
    with atomic_path(matches) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        for putative, verified in zip(job.paths("matches"), job.paths("geometries"), strict=True):
            written += _write_tile(file, putative, verified, names, places, options.matches)
    with atomic_path(pairs) as temporary:
        temporary.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in sorted(written)), "utf-8")
    # hloc splits at any white space
    if any(len(names[image].split()) > 1 for pair in written for image in pair):
        job.warn(SPACES)
    print(f"{len(places)} images, {len(written)} pairs with {options.matches} matches")


def _write_block(file: h5py.File, path: Path, names: list[str]) -> dict[int, Array]:
    """Features of one block's images; by image the first keypoint (N,) int32 at each keypoint's place."""
    # brings OpenCV along, which a stage's import must not
    from snakesfm.two_view.correspondences import first_rows_at_place

    block = LocalFeatures.read(path)
    places = {}
    for row, image in enumerate(block.image_ids.tolist()):
        part = slice(block.offsets[row], block.offsets[row + 1])
        columns = {name: getattr(block, name)[part] for name in COLUMNS}
        width, height = block.sizes[row].tolist()
        write_hloc_features(file, names[image], columns, (width, height))
        places[image] = first_rows_at_place(columns["keypoints"]).astype(np.int32)
    return places


def _write_tile(
    file: h5py.File,
    putative: Path,
    verified: Path,
    names: list[str],
    places: dict[int, Array],
    which: str,
) -> list[tuple[int, int]]:
    """Matches of one tile's pairs; the pairs that have some."""
    tile, geometries = PairMatches.read(putative), TwoViewGeometries.read(verified)
    written = []
    for row, (i, j) in enumerate(tile.pairs.tolist()):
        part = slice(tile.offsets[row], tile.offsets[row + 1])
        matches, scores = tile.matches[part], tile.scores[part]
        if which == "inliers":
            found = np.column_stack([places[i][matches[:, 0]], places[j][matches[:, 1]]])
            matches, scores = _inliers(geometries, row, found, scores)
        if len(matches):
            write_hloc_matches(file, (names[i], names[j]), matches, scores, len(places[i]))
            written.append((i, j))
    return written


def _inliers(geometries: TwoViewGeometries, row: int, matches: Array, scores: Array) -> tuple[Array, Array]:
    """Inliers (K,2) of a pair's accepted pose, and of each the best score (K,) of a match at its places."""
    if geometries.rejections[row] != 0:
        return np.zeros((0, 2), np.int32), np.zeros(0, np.float32)
    inliers = geometries.inliers[geometries.offsets[row] : geometries.offsets[row + 1]]
    # inliers are counted by the first keypoint at a place, so that each place is there once
    joined, place = np.unique(np.concatenate([inliers, matches]), axis=0, return_inverse=True)
    best = np.zeros(len(joined), np.float32)
    np.maximum.at(best, place[len(inliers) :], scores)
    return inliers, best[place[: len(inliers)]]
