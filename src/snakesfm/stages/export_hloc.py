"""export_hloc: features, matches and the list of pairs in the files of hloc."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from snakesfm.artifacts import ImageIndex, LocalFeatures, PairMatches, TwoViewGeometries, atomic_path
from snakesfm.artifacts.hloc import clashing_names, write_hloc_features, write_hloc_matches
from snakesfm.errors import ConfigError
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.export_hloc import ExportHlocOptions

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
            f"hloc's files cannot tell the images '{clash[0]}' and '{clash[1]}' apart: rename one of them."
        )
    features, matches, pairs = job.outputs
    counts: dict[int, int] = {}
    with atomic_path(features) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        for path in job.paths("features"):
            counts |= _write_block(file, path, names)
    written: list[tuple[int, int]] = []
    with atomic_path(matches) as temporary, h5py.File(temporary, "w", libver="latest") as file:
        for putative, verified in zip(job.paths("matches"), job.paths("geometries"), strict=True):
            written += _write_tile(file, putative, verified, names, counts, options.matches)
    with atomic_path(pairs) as temporary:
        temporary.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in sorted(written)), "utf-8")
    print(f"{len(counts)} images, {len(written)} pairs with {options.matches} matches")


def _write_block(file: h5py.File, path: Path, names: list[str]) -> dict[int, int]:
    """Features of one block's images; how many keypoints each has."""
    block = LocalFeatures.read(path)
    counts = {}
    for row, image in enumerate(block.image_ids.tolist()):
        part = slice(block.offsets[row], block.offsets[row + 1])
        columns = {name: getattr(block, name)[part] for name in COLUMNS}
        width, height = block.sizes[row].tolist()
        write_hloc_features(file, names[image], columns, (width, height))
        counts[image] = len(columns["keypoints"])
    return counts


def _write_tile(
    file: h5py.File, putative: Path, verified: Path, names: list[str], counts: dict[int, int], which: str
) -> list[tuple[int, int]]:
    """Matches of one tile's pairs; the pairs that have some."""
    tile, geometries = PairMatches.read(putative), TwoViewGeometries.read(verified)
    written = []
    for row, (i, j) in enumerate(tile.pairs.tolist()):
        part = slice(tile.offsets[row], tile.offsets[row + 1])
        matches, scores = tile.matches[part], tile.scores[part]
        if which == "inliers":
            kept = _rows_of(geometries, row, matches)
            matches, scores = matches[kept], scores[kept]
        if len(matches):
            write_hloc_matches(file, (names[i], names[j]), matches, scores, counts[i])
            written.append((i, j))
    return written


def _rows_of(geometries: TwoViewGeometries, row: int, matches: Any) -> Any:
    """Which matches (M,2) of a pair are inliers of its accepted pose, (M,) bool."""
    if geometries.rejections[row] != 0:
        return np.zeros(len(matches), bool)
    inliers = geometries.inliers[geometries.offsets[row] : geometries.offsets[row + 1]]
    # a row of the first image is matched once at most, so it tells the match
    return np.isin(matches[:, 0], inliers[:, 0])
