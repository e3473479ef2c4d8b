"""Disjoint sets over inlier matches."""

from dataclasses import dataclass

import numpy as np

from snakesfm.arrays import Array
from snakesfm.grouping import components_of, offsets_of, starts_of
from snakesfm.tracks.confirmation import unconfirmed_links


@dataclass(frozen=True)
class Tracks:
    """Tracks, flat: rows ``offsets[k]:offsets[k+1]`` of the other arrays belong to track k.

    Parameters
    ----------
    offsets : (T+1,) int64.
    image_ids : (L,) int32, ascending within a track.
    keypoint_ids : (L,) int32, row of the keypoint in its image.
    part_ids : (L,) int32, parts of tracks that hang together by confirmed matches, over all tracks.
    conflicts : components of matches that saw an image at two places.
    """

    offsets: Array
    image_ids: Array
    keypoint_ids: Array
    part_ids: Array
    conflicts: int


def build_tracks(
    keypoints: list[Array],
    pairs: Array,
    offsets: Array,
    matches: Array,
    min_length: int = 3,
    merge_radius_px: float = 1.0,
    sparse_observations: int = 0,
) -> Tracks:
    """Join matches to tracks that see each image at most once.

    Connected components of the match graph. Those that see an image at two places are dropped. SIFT gives
    one place once per dominant orientation; such keypoints make tracks of their own unless a match joins
    them. Without the links of :func:`snakesfm.tracks.confirmation.unconfirmed_links` a track falls into
    parts.

    Parameters
    ----------
    keypoints : per image (K_i,2) float32, pixels.
    pairs : (P,2) int, images i < j.
    offsets : (P+1,) int64, rows ``offsets[k]:offsets[k+1]`` of ``matches`` belong to pair k.
    matches : (M,2) int, keypoint rows in image i and in image j.
    min_length : images that a track must be seen in.
    merge_radius_px : keypoints of one image within this distance are one observation.
    sparse_observations : an image with fewer observations of such tracks keeps its shorter ones too.

    Returns
    -------
    Tracks sorted by their first observation.

    Source: Moulon and Monasse, Unordered feature tracking made fast and easy, CVMP 2012, where components
    in conflict are dropped; parts and the exception for sparse images are this project's own.
    """
    base = offsets_of([len(k) for k in keypoints])
    pair_of = np.repeat(np.arange(len(pairs)), np.diff(offsets))
    links = np.stack([base[pairs[pair_of, side]] + matches[:, side] for side in (0, 1)], axis=1)
    keys = np.unique(links[:, 0] * base[-1] + links[:, 1])
    links = np.stack([keys // base[-1], keys % base[-1]], axis=1)

    matched = np.zeros(base[-1], dtype=bool)
    matched[links] = True
    nodes = np.flatnonzero(matched)
    links = (np.cumsum(matched) - 1)[links]
    images = (np.searchsorted(base, nodes, side="right") - 1).astype(np.int64)
    parts = components_of(len(nodes), links[~unconfirmed_links(links, images)])
    labels = components_of(len(nodes), links)
    positions = np.concatenate(keypoints)[nodes] if len(nodes) else np.zeros((0, 2))
    in_conflict = _conflicting(labels, images, positions, merge_radius_px)
    conflicts = len(np.unique(labels[in_conflict]))
    labels[in_conflict] = -1
    observed = _one_per_image(labels, images, np.bincount(links.ravel(), minlength=len(nodes)))
    labels, parts, images = labels[observed], parts[observed], images[observed]
    rows = nodes[observed] - base[images]
    lengths = np.bincount(labels)[labels]
    long = lengths >= min_length
    sparse = np.bincount(images[long], minlength=len(keypoints)) < sparse_observations
    of_sparse = np.bincount(labels, weights=sparse[images])[labels] > 0
    return _assemble(labels, parts, images, rows, long | (of_sparse & (lengths >= 2)), conflicts)


def _conflicting(labels: Array, images: Array, positions: Array, merge_radius_px: float) -> Array:
    """Nodes (K,) bool of components that see one image at places further apart than ``merge_radius_px``."""
    # nodes ascend by image
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(starts_of(labels[order], images[order]))
    bad = np.zeros(int(labels.max(initial=-1)) + 1, dtype=bool)
    if len(starts) < len(order):
        points = positions[order]
        extent = np.maximum.reduceat(points, starts) - np.minimum.reduceat(points, starts)
        bad[labels[order][starts[np.hypot(*extent.T) > merge_radius_px]]] = True
    return np.asarray(bad[labels])


def _one_per_image(labels: Array, images: Array, degrees: Array) -> Array:
    """Nodes (K,) bool that stand for their place: the best linked of each track and image."""
    order = np.lexsort((-degrees, images, labels))
    observed = np.zeros(len(labels), dtype=bool)
    observed[order[starts_of(labels[order], images[order])]] = True
    return observed & (labels >= 0)


def _assemble(
    labels: Array, parts: Array, images: Array, rows: Array, kept: Array, conflicts: int
) -> Tracks:
    # nodes ascend by image and keypoint, so a track's first node is its first observation
    first = np.zeros(int(labels.max(initial=-1)) + 1, dtype=np.int64)
    first[labels[::-1]] = np.arange(len(labels))[::-1]
    rank = first[labels]
    order = np.nonzero(kept)[0]
    order = order[np.argsort(rank[order], kind="stable")]
    offsets = np.append(np.flatnonzero(starts_of(rank[order])), len(order))
    keys = rank[order] * (parts.max(initial=0) + 1) + parts[order]
    part_ids = np.unique(keys, return_inverse=True)[1]
    return Tracks(
        offsets,
        images[order].astype(np.int32),
        rows[order].astype(np.int32),
        part_ids.astype(np.int32),
        conflicts,
    )
