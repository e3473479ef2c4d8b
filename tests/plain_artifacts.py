"""Artifacts in which all is plain but what a test names."""

import numpy as np

from snakesfm.artifacts import CalibratedCameras, Header, ImageIndex, PairMatches, TrackTable
from snakesfm.geometry.camera import cameras_to_columns

HEADER = Header("test", 1, "scene")


def write_plain_index(path, names, sizes, cameras=(), **columns):
    """Write the index of images (N names and sizes) without EXIF or refused files, but for columns not None."""
    count = len(names)
    models, camera_sizes, params, sources = cameras_to_columns(cameras)
    plain = {
        "sha256": [""] * count,
        "blocks": np.zeros(count, int),
        "camera_ids": np.zeros(count, int),
        "orientations": np.ones(count, int),
        "focal_exif_px": np.full(count, np.nan),
        "gps": np.full((count, 3), np.nan),
        "duplicate_of": np.full(count, -1),
        "refused_names": [],
        "refused_reasons": [],
        "warnings": [],
    }
    ImageIndex(
        names=names,
        sizes=np.array(sizes),
        camera_models=models,
        camera_sizes=camera_sizes,
        camera_params=params,
        camera_sources=sources,
        **plain | {name: values for name, values in columns.items() if values is not None},
    ).write(path, HEADER)


def write_plain_cameras(path, cameras, sigmas=np.nan, warnings=()):
    """Write calibrated cameras for which no pairs voted, without an overlay."""
    count = len(cameras)
    sigmas = np.broadcast_to(sigmas, count)
    none = np.zeros((0, 4), int)
    CalibratedCameras(*cameras_to_columns(cameras), sigmas, np.zeros(count, int), none, warnings).write(
        path, HEADER
    )


def write_plain_matches(path, pairs, matches, scores=None):
    """Write the matches, an array (M,2) for each of the pairs, all of one score if none are given."""
    flat = np.concatenate([np.zeros((0, 2), int), *matches])
    PairMatches(
        pairs=pairs,
        digests=[""] * len(pairs),
        offsets=np.cumsum([0, *map(len, matches)]),
        matches=flat,
        scores=np.ones(len(flat)) if scores is None else scores,
    ).write(path, HEADER)


def write_plain_tracks(path, made):
    """Write the tracks of a synthetic problem, without colours, each from a part of its own."""
    count = len(made.track_image_ids)
    TrackTable(
        offsets=made.track_offsets,
        image_ids=made.track_image_ids,
        keypoint_ids=made.track_keypoint_ids,
        part_ids=np.repeat(np.arange(len(made.track_offsets) - 1), np.diff(made.track_offsets)),
        keypoints=made.track_keypoints,
        colors=np.zeros((count, 3), np.uint8),
        lengths_unmerged=np.zeros(0, int),
        lengths_merged=np.zeros(0, int),
    ).write(path, HEADER)
