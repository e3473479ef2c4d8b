"""Columns of artifacts collected from the files of all blocks or tiles."""

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np

from snakesfm.arrays import Array
from snakesfm.artifacts.features import LocalFeatures
from snakesfm.artifacts.pairs import REJECTIONS, TwoViewGeometries
from snakesfm.errors import ArtifactError
from snakesfm.grouping import offsets_of


def gather_image_columns(
    paths: Sequence[Path], count: int, *columns: str, images: Collection[int] | None = None
) -> list[list[Array]]:
    """Columns of local features per image of the scene, without reading the others.

    Parameters
    ----------
    paths : the LocalFeatures files of all blocks.
    count : images of the index.
    columns : names of per-keypoint columns, such as ``keypoints``.
    images : rows of the images that are wanted; all if None.

    Returns
    -------
    Per column a list over the images; empty arrays for images without features or not wanted.
    """
    gathered: list[list[Array]] = [[np.zeros((0, 0))] * count for _ in columns]
    for path in paths:
        with LocalFeatures.open(path) as file:
            ids, offsets = file["image_ids"][()], file["offsets"][()]
            wanted = [row for row, image in enumerate(ids.tolist()) if images is None or image in images]
            for values, name in zip(gathered, columns, strict=True):
                column = file[name] if len(wanted) < len(ids) else file[name][()]
                for row in wanted:
                    values[ids[row]] = column[offsets[row] : offsets[row + 1]]
    for values in gathered:
        shape, dtype = next(((v.shape[1:], v.dtype) for v in values if v.size), ((2,), np.dtype("f4")))
        values[:] = [v if v.size else np.zeros((0, *shape), dtype) for v in values]
    return gathered


def gather_keypoints(
    paths: Iterable[Path], images: Collection[int], names: Array
) -> tuple[dict[int, Array], dict[int, str]]:
    """Keypoints (K,2) float32 and digests of matched images, by row of the index.

    Parameters
    ----------
    paths : LocalFeatures files that hold them.
    images : rows of the index.
    names : (N,) str, the index's names of images.

    Raises
    ------
    ArtifactError : no file holds one of the images.
    """
    keypoints: dict[int, Array] = {}
    digests: dict[int, str] = {}
    for path in paths:
        with LocalFeatures.open(path) as file:
            offsets, of_rows = file["offsets"][()], file["digests"].asstr()[()]
            column = file["keypoints"]
            for row, image in enumerate(file["image_ids"][()].tolist()):
                if image in images:
                    keypoints[image] = column[offsets[row] : offsets[row + 1]]
                    digests[image] = str(of_rows[row])
    for image in sorted(set(images) - keypoints.keys()):
        raise ArtifactError(
            f"Image '{names[image]}' has matches, but is in no features file: delete the folders "
            "extract_features and match_pairs of its scene and run again."
        )
    return keypoints, digests


def gather_inlier_matches(paths: Sequence[Path], pairs: Array) -> tuple[Array, Array, Array]:
    """Inlier matches of pairs of all tiles, sorted by pair.

    Parameters
    ----------
    paths : the TwoViewGeometries files of all tiles.
    pairs : (E,2) the pairs that are wanted, refused ones too.

    Returns
    -------
    pairs (P,2) int32, offsets (P+1,) int64 and matches (M,2) int32, keypoint rows in image i and j.
    """
    wanted = {tuple(pair) for pair in pairs.tolist()}
    parts: list[tuple[tuple[int, int], Array]] = []
    for path in paths:
        with TwoViewGeometries.open(path) as file:
            tile, offsets = file["pairs"][()].tolist(), file["offsets"][()]
            rows = [row for row in np.nonzero(np.diff(offsets))[0].tolist() if tuple(tile[row]) in wanted]
            if not rows:
                continue
            first = offsets[rows[0]]
            inliers = file["inliers"][first : offsets[rows[-1] + 1]]
        for row in rows:
            i, j = tile[row]
            parts.append(((i, j), inliers[offsets[row] - first : offsets[row + 1] - first]))
    parts.sort(key=lambda part: part[0])
    found = np.array([pair for pair, _ in parts], dtype=np.int32).reshape(-1, 2)
    starts = offsets_of([len(matches) for _, matches in parts])
    matches = np.concatenate([matches for _, matches in parts] or [np.zeros((0, 2), dtype=np.int32)])
    return found, starts, matches


def gather_refused_pairs(paths: Sequence[Path]) -> Array:
    """Pairs (P,2) int32 of all tiles whose matches agree with a pose that was refused all the same.

    Ambiguous pairs are left out: their matches may be those of the wrong pose of two.

    Parameters
    ----------
    paths : the TwoViewGeometries files of all tiles.
    """
    found = [np.zeros((0, 2), dtype=np.int32)]
    for path in paths:
        with TwoViewGeometries.open(path) as file:
            refused = ~np.isin(file["rejections"][()], (0, REJECTIONS.index("ambiguous")))
            found.append(file["pairs"][()][refused & (file["inlier_counts"][()] > 0)])
    return np.concatenate(found)
