"""Choose the pairs of images that are matched."""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.features import GlobalDescriptors, LocalFeatures
from snakesfm.artifacts.hloc import open_hloc, read_hloc_pairs
from snakesfm.artifacts.images import ImageIndex
from snakesfm.artifacts.pairs import ImagePairs
from snakesfm.errors import ConfigError
from snakesfm.geometry.earth import local_metres, local_origin
from snakesfm.pair_lists import is_matches_file
from snakesfm.retrieval.listed import listed_pairs
from snakesfm.retrieval.pairs import (
    PairTable,
    exhaustive_pairs,
    natural_order,
    sequential_pairs,
    similar_pairs,
    spatial_pairs,
)
from snakesfm.retrieval.preview import alike_pairs, choose_partners, largest_keypoints, look_at_pairs
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.select_pairs import SelectPairsOptions

# how many pairs are previewed between two progress messages: about a second
LOOKS_AT_ONCE = 2_000


def run(job: StageJob) -> None:
    """Choose pairs by the method, which is no longer 'auto', and write one ImagePairs per tile.

    Where there are SIFT features, the method's pairs are looked at first, and each image keeps so many. A
    tile without pairs gets an empty one.
    """
    index = ImageIndex.read(job.path("index"))
    pairs_file = str(job.settings["pairs_file"])
    options: SelectPairsOptions = job.options
    table = _follow_list(job, index, pairs_file) if options.method == "listed" else _propose(job, index)
    proposed = len(table.pairs)
    likenesses = np.full(proposed, np.nan, np.float32)
    if options.preview_keypoints:
        likenesses, stays = _look(job, table, len(index.names), options)
        table, likenesses = table.take(stays), likenesses[stays]
    blocks = int(job.settings["blocks"])
    tiles = np.sort(index.blocks[table.pairs].astype(np.int64), axis=1) @ [blocks, 1]
    order = np.argsort(tiles, kind="stable")
    tiles = tiles[order]
    for tile in itertools.combinations_with_replacement(range(blocks), 2):
        number = tile[0] * blocks + tile[1]
        first, last = np.searchsorted(tiles, [number, number + 1])
        part = table.take(order[first:last])
        ImagePairs(
            pairs=part.pairs,
            reasons=np.array(part.reason_texts(), dtype=object),
            similarities=part.similarities,
            likenesses=likenesses[order[first:last]],
        ).write(job.output.with_name(f"{tile[0]}-{tile[1]}.h5"), job.header)
    print(f"{len(table.pairs)} of {proposed} pairs of {len(index.names)} images ({options.method})")


def _look(
    job: StageJob, table: PairTable, images: int, options: "SelectPairsOptions"
) -> tuple[Array, Array]:
    """The likeness (P,) of pairs, and which stay (P,) bool."""
    previews = read_previews(job.paths("features"), images, options.preview_keypoints)
    likenesses = np.full(len(table.pairs), np.nan, np.float32)
    progress = job.progress(len(likenesses), "pairs previewed")
    for start in range(0, len(likenesses), LOOKS_AT_ONCE):
        part = slice(start, start + LOOKS_AT_ONCE)
        likenesses[part] = look_at_pairs(
            table.pairs[part], previews, options.preview_keypoints, job.threads
        )
        progress.step(len(likenesses[part]))
    counts = np.array([len(preview) for preview in previews])
    few = counts < options.preview_keypoints
    if few.any():
        print(f"{few.sum()} images have fewer than {2 * options.preview_keypoints} keypoints to preview")
    unsure = np.asarray(few[table.pairs].any(axis=1) & (counts[table.pairs] > 1).all(axis=1))
    stays = alike_pairs(table.pairs, likenesses, unsure, options.min_likeness, options.least_partners)
    if options.enough_partners:
        rows, enough = np.flatnonzero(stays), (options.enough_partners, options.enough_likeness)
        stays[rows] = choose_partners(table.pairs[rows], likenesses[rows], *enough)
    return likenesses, stays


def read_previews(paths: list[Path], images: int, count: int) -> list[Array]:
    """Descriptors (n,D) of the largest keypoints of every image of the index, see largest_keypoints."""
    previews: list[Array] = [np.zeros((0, 1), np.uint8)] * images
    for path in paths:
        with LocalFeatures.open(path) as file:
            scales, descriptors = file["scales"][()], file["descriptors"]
            offsets = file["offsets"][()].tolist()
            for row, image in enumerate(file["image_ids"][()].tolist()):
                part = slice(offsets[row], offsets[row + 1])
                previews[image] = descriptors[part][largest_keypoints(scales[part], count)]
    return previews


def _follow_list(job: StageJob, index: ImageIndex, pairs_file: str) -> PairTable:
    names = [str(name) for name in index.names]
    if is_matches_file(pairs_file):
        return _matched_pairs(job, pairs_file, names)
    return _read_list(job, pairs_file, names, [str(name) for name in index.refused_names])


def _propose(job: StageJob, index: ImageIndex) -> PairTable:
    """The method's pairs, among images of which the first of several with the same bytes stands for all."""
    options: SelectPairsOptions = job.options
    rows = np.flatnonzero(index.duplicate_of < 0)
    names = [str(name) for name in index.names[rows]]
    table = PairTable.of(np.zeros((0, 2)), "sequential")
    if options.method == "exhaustive":
        table = exhaustive_pairs(len(names))
    if "sequential" in options.method:
        table = table.union(sequential_pairs(names, options.look_ahead))
    if "spatial" in options.method:
        places = _local_places(index.gps[rows])
        table = table.union(spatial_pairs(places, int(options.top_k)))
        unplaced = ~np.isfinite(places[:, 0])
        if unplaced.any():
            job.warn(
                f"{unplaced.sum()} of {len(names)} images have no GPS position in EXIF: they are paired "
                "with neighbours by name alone."
            )
        if options.method == "spatial":
            # as many before and behind as others have around
            by_name = sequential_pairs(names, math.ceil(int(options.top_k) / 2))
            table = table.union(by_name.take(np.flatnonzero(unplaced[by_name.pairs].any(axis=1))))
    if "retrieval" in options.method:
        order = natural_order(names) if "sequential" in options.method else None
        table = table.union(_retrieve(job, rows, order))
    return replace(table, pairs=rows[table.pairs])


def _local_places(gps: Array) -> Array:
    """Metres east and north (N,2) of images with GPS (N,3), NaN where EXIF does not tell.

    Height is left out: EXIF often has it from another zero, or not at all.
    """
    places = np.column_stack([gps[:, :2], np.zeros(len(gps))])
    origin = local_origin(places)
    if origin is None:
        raise ConfigError(
            "select_pairs.method pairs images by their GPS position, but none has one in EXIF: "
            "use --config 'select_pairs={method: sequential+retrieval}'."
        )
    return local_metres(places, origin)[:, :2]


def _read_list(job: StageJob, path: str, names: list[str], refused: list[str]) -> PairTable:
    if not path:
        raise ConfigError("select_pairs.method is 'listed' but no list is given: use --config pairs=FILE.")
    try:
        lines = Path(path).expanduser().read_text("utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"The list of pairs '{path}' cannot be read ({error}): give a UTF-8 text file."
        ) from None
    table, skipped = listed_pairs(lines, names, refused, path)
    if skipped:
        job.warn(
            f"{skipped} pairs of '{path}' are left out: they name an image that cannot be used, as the "
            "report says."
        )
    return table


def _matched_pairs(job: StageJob, path: str, names: list[str]) -> PairTable:
    """The pairs of images that hloc's file of matches holds."""
    with open_hloc(Path(path).expanduser()) as file:
        pairs, others = read_hloc_pairs(file, names)
    if not len(pairs):
        raise ConfigError(
            f"'{path}' has no matches between images of this scene ({others} pairs of other images): its "
            "image names must be relative to the image folder."
        )
    if others:
        job.warn(f"{others} pairs of '{path}' are left out: they name an image that is not used.")
    return PairTable.of(pairs, "listed")


def _retrieve(job: StageJob, rows: Array, order: Array | None) -> PairTable:
    """Similar ones of some rows of the index, as places in ``rows``, which ``order`` sorts by name."""
    options: SelectPairsOptions = job.options
    paths, kept, places = job.paths("descriptors"), [], []
    for path in paths:
        with GlobalDescriptors.open(path) as file:
            image_ids = file["image_ids"][()]
        kept.append(np.isin(image_ids, rows))
        places.append(np.searchsorted(rows, image_ids[kept[-1]]))
    return similar_pairs(
        places,
        lambda block: GlobalDescriptors.read(paths[block]).descriptors[kept[block]],
        int(options.top_k),
        options.min_score,
        threads=job.threads,
        order=order,
        look_ahead=options.look_ahead,
    )
