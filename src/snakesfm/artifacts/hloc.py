"""Reading and writing of hloc's features and matches (github.com/cvg/Hierarchical-Localization).

``features.h5`` has a group per image with ``keypoints`` (N,2), ``descriptors`` (D,N), ``scores`` (N,) and
``image_size``; other tools write ``keypoints`` (N,4) as COLMAP has them. ``matches.h5`` has a group per
pair with ``matches0`` (N0,), the row in the second image or -1, and ``matching_scores0``; ``pairs.txt`` has
two names a line. hloc's first pixel has its centre at (0, 0).
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ConfigError
from snakesfm.hloc_files import FEATURES, MATCHES, PAIRS

CENTER_SHIFT = np.float32(0.5)
# old versions joined the names of a pair by another sign
JOINTS = ("/", "_")
UNMATCHED = -1
# groups that are opened while the Snakefile is parsed: some milliseconds
LOOKS = 100
# COLMAP's keypoints have two, four or six columns
MOST_COLUMNS = 6


def open_hloc(path: Path) -> h5py.File:
    """Open a file of hloc for reading.

    Raises
    ------
    ConfigError : it is missing or no HDF5 file.
    """
    try:
        return h5py.File(path, "r", locking=False)
    except OSError:
        raise ConfigError(
            f"{path} is missing or not an HDF5 file: set imported=DIR to a folder with hloc's features as "
            f"{FEATURES}, its matches as {MATCHES} and its list of pairs as {PAIRS}."
        ) from None


def read_hloc_features(file: h5py.File, name: str) -> dict[str, Array] | None:
    """One image's features; None where the file knows nothing of the image.

    Four columns of keypoints are x, y, scale and angle, as in COLMAP; of others the first two are taken.

    Returns
    -------
    keypoints : (N,2) float32, the first pixel's centre at (.5, .5).
    descriptors : (N,D) float16, D = 0 where there are none.
    scores : (N,) float32, ones where there are none.
    scales : (N,) float32, ones where there are none.
    angles : (N,) float32 radians, zeros where there are none.

    Raises
    ------
    ConfigError : the image's arrays do not fit together, or its keypoints are no rows of x and y.
    """
    group = _features_of(file, name)
    if group is None:
        return None
    rows = group["keypoints"][()].astype(np.float32)
    if rows.size == 0:
        rows = np.zeros((0, 2), np.float32)
    if rows.ndim != 2 or not 2 <= rows.shape[1] <= MOST_COLUMNS:
        raise ConfigError(
            f"{file.filename} has keypoints of shape {rows.shape} for '{name}', which are not rows of "
            "x and y: write it again with hloc."
        )
    count = len(rows)
    none = np.zeros((0, count))
    scales, angles = rows[:, 2:].T if rows.shape[1] == 4 else (np.ones(count), np.zeros(count))
    if "oris" in group:
        angles = np.deg2rad(group["oris"][()].ravel())
    # where there is no keypoint, tools write descriptors of any shape
    descriptors = _optional(group, "descriptors", none) if count else none
    # what half precision cannot hold becomes infinite, which is told where it is read
    with np.errstate(over="ignore"):
        descriptors = descriptors.astype(np.float16)
    found = {
        "keypoints": rows[:, :2] + CENTER_SHIFT,
        "descriptors": descriptors.T,
        "scores": _optional(group, "scores", np.ones(count)).ravel().astype(np.float32),
        "scales": _optional(group, "scales", scales).ravel().astype(np.float32),
        "angles": angles.astype(np.float32),
    }
    if descriptors.ndim != 2 or any(len(column) != count for column in found.values()):
        raise ConfigError(
            f"{file.filename} has {count} keypoints for '{name}', but another number of descriptors or "
            "scores: write it again with hloc."
        )
    return found


def read_hloc_size(file: h5py.File, name: str) -> tuple[int, int] | None:
    """Width and height in pixels of the image that hloc found an image's keypoints in; None where not told.

    Raises
    ------
    ConfigError : what is told is no size.
    """
    group = _features_of(file, name)
    if group is None or "image_size" not in group:
        return None
    told = np.ravel(group["image_size"][()])
    if len(told) != 2 or not (told >= 1).all():
        raise ConfigError(
            f"{file.filename} has an image_size for '{name}' that is not a width and a height: write it "
            "again with hloc."
        )
    return int(told[0]), int(told[1])


def _features_of(file: h5py.File, name: str) -> h5py.Group | None:
    group = file.get(name)
    return group if isinstance(group, h5py.Group) and "keypoints" in group else None


def descriptor_size(file: h5py.File) -> int:
    """Length of the descriptors of the first image that has some; 0 where none has."""
    sizes: list[int] = []

    def visit(name: str, item: Any) -> int | None:
        known = isinstance(item, h5py.Dataset) and name.rpartition("/")[2] == "descriptors"
        if known and item.ndim == 2 and item.shape[0]:
            sizes.append(int(item.shape[0]))
        return sizes[0] if sizes else None

    file.visititems(visit)
    return sizes[0] if sizes else 0


def read_hloc_pairs(file: h5py.File, names: Sequence[str]) -> tuple[Array, int]:
    """The pairs of images that a file has matches of, however their names are joined.

    Parameters
    ----------
    file : hloc's matches.
    names : N images.

    Returns
    -------
    pairs : (P,2) int64 rows of ``names``, in the order of the file, maybe some twice or turned.
    others : how many pairs have an image that is not among the names.
    """
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        rows.setdefault(name.replace("/", "-"), []).append(row)
    pairs: list[tuple[int, int]] = []
    others = 0
    for outer, group in file.items():
        if not isinstance(group, h5py.Group):
            continue
        for joined in _joined_names(outer, group):
            found = next((both for both in joined if both[0] in rows and both[1] in rows), None)
            if found is None:
                others += 1
            else:
                pairs += itertools.product(rows[found[0]], rows[found[1]])
    return np.array(pairs, np.int64).reshape(-1, 2), others


def _joined_names(outer: str, group: h5py.Group) -> Iterator[list[tuple[str, str]]]:
    """Of each pair in one of a file's groups, the names that it may be of."""
    if "matches0" in group:
        # an old version's: names may hold the joint as well
        places = [place for place, sign in enumerate(outer) if sign == JOINTS[1]]
        yield [(outer[:place], outer[place + 1 :]) for place in places]
    else:
        yield from ([(outer, inner)] for inner in group)


def estimate_hloc_pairs(file: h5py.File) -> int:
    """About how many pairs a file has matches of, by a look at some of its groups."""
    names = list(file)
    # a link may lead nowhere
    groups = [file.get(name) for name in names[:: len(names) // LOOKS + 1]]
    counts = [1 if "matches0" in group else len(group) for group in groups if isinstance(group, h5py.Group)]
    return round(len(names) * sum(counts) / max(1, len(groups)))


def read_hloc_matches(
    file: h5py.File, names: tuple[str, str], counts: tuple[int, int]
) -> tuple[Array, Array] | None:
    """The matches of a pair, whichever way round and with whichever joint it is stored; None without any.

    Returns
    -------
    matches : (K,2) int32 rows of the first and second image, ascending.
    scores : (K,) float32.

    Raises
    ------
    ConfigError : a row lies beyond the image's keypoints, or there are not as many scores.
    """
    for turned in (False, True):
        first, second = names[::-1] if turned else names
        for joint in JOINTS:
            group = file.get(joint.join(name.replace("/", "-") for name in (first, second)))
            if isinstance(group, h5py.Group) and "matches0" in group:
                partners = group["matches0"][()].astype(np.int64).ravel()
                scores = _optional(group, "matching_scores0", np.ones(len(partners))).ravel()
                if len(scores) != len(partners):
                    raise ConfigError(
                        f"{file.filename} has {len(partners)} matches0 for '{names[0]}' and '{names[1]}', "
                        f"but {len(scores)} matching_scores0: write it again with hloc."
                    )
                rows = np.flatnonzero(partners != UNMATCHED)
                pairs = np.column_stack([rows, partners[rows]])
                values = scores[rows].astype(np.float32)
                if turned:
                    order = np.argsort(pairs[:, 1], kind="stable")
                    pairs, values = pairs[order, ::-1], values[order]
                if len(pairs) and (pairs.min() < 0 or (pairs.max(axis=0) >= counts).any()):
                    raise ConfigError(
                        f"{file.filename} matches keypoints of '{names[0]}' and '{names[1]}' that "
                        f"{FEATURES} does not have: use features and matches from the same run of hloc."
                    )
                return pairs.astype(np.int32), values
    return None


def _optional(group: h5py.Group, name: str, default: Array) -> Array:
    return np.asarray(group[name][()]) if name in group else default


def write_hloc_features(
    file: h5py.File, name: str, columns: dict[str, Array], image_size: tuple[int, int]
) -> None:
    """Add an image's features; the arguments are those that :func:`read_hloc_features` returns.

    Keypoints stay float32, as float16 would put them a pixel off in large images; readers take either.
    Descriptors of whole numbers, as of SIFT, get length 1, which hloc's matchers and thresholds assume.
    """
    descriptors = columns["descriptors"]
    if descriptors.dtype.kind in "iu":
        descriptors = descriptors.astype(np.float32)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1.0)
    group = file.create_group(name)
    group["keypoints"] = columns["keypoints"].astype(np.float32) - CENTER_SHIFT
    group["descriptors"] = descriptors.T.astype(np.float16)
    group["scores"] = columns["scores"].astype(np.float32)
    group["scales"] = columns["scales"].astype(np.float32)
    group["oris"] = np.rad2deg(columns["angles"]).astype(np.float32)
    group["image_size"] = np.array(image_size, np.int64)


def write_hloc_matches(
    file: h5py.File, names: tuple[str, str], matches: Array, scores: Array, count: int
) -> None:
    """Add a pair's matches (K,2) and scores (K,); the first image has ``count`` keypoints."""
    group = file.create_group("/".join(name.replace("/", "-") for name in names))
    partners = np.full(count, UNMATCHED, np.int32)
    values = np.zeros(count, np.float16)
    partners[matches[:, 0]] = matches[:, 1]
    values[matches[:, 0]] = scores
    group["matches0"] = partners
    group["matching_scores0"] = values


def clashing_names(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Pairs of names that hloc's files cannot tell apart, as ``a/b.jpg`` and ``a-b.jpg``."""
    seen: dict[str, str] = {}
    for name in names:
        flat = name.replace("/", "-")
        if flat in seen:
            yield seen[flat], name
        seen.setdefault(flat, name)
