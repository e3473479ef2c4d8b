"""Points, observations and keypoints of a ``pycolmap.Reconstruction`` as arrays."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesfm.arrays import Array
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_files import (
    COUNT,
    ELEMENT,
    IMAGES_FILE,
    KEYPOINT,
    POINT,
    POINTS_FILE,
    read_image_head,
    written_files,
)
from snakesfm.grouping import rows_of_each


@dataclass(frozen=True)
class Tracks:
    """Points by ascending id, and their observations in the order of the tracks.

    Parameters
    ----------
    ids, points : (T,) int64 and (T,3) float64.
    point_rows : (L,) int64, ascending, row of each observation's point.
    images, rows : (L,) int64, row (not id) of each observation's image, and of its keypoint there.
    """

    ids: Array
    points: Array
    point_rows: Array
    images: Array
    rows: Array


def read_tracks(reconstruction: pycolmap.Reconstruction) -> Tracks:
    """The points and observations of a reconstruction.

    Raises
    ------
    ConfigError : the installed pycolmap has binary files of another layout.
    """
    with written_files(reconstruction) as folder:
        return _tracks(folder / POINTS_FILE)


def read_tracks_and_pixels(reconstruction: pycolmap.Reconstruction) -> tuple[Tracks, Array]:
    """The same and, per observation, the pixel (L,2) float64 where its keypoint is now."""
    with written_files(reconstruction) as folder:
        tracks = _tracks(folder / POINTS_FILE)
        return tracks, _pixels(folder / IMAGES_FILE, tracks)


def read_keypoints(reconstruction: pycolmap.Reconstruction) -> dict[int, Array]:
    """The pixels (K,2) float64 of all keypoints of each registered image, by its id."""
    with written_files(reconstruction) as folder:
        return dict(_keypoints_of_images(folder / IMAGES_FILE))


def points_in_cameras(reconstruction: pycolmap.Reconstruction, tracks: Tracks) -> tuple[Array, Array]:
    """Id of the camera (L,) int64 of each observation, and its point (L,3) in the camera's frame."""
    camera_of, points = np.empty(len(tracks.images), dtype=np.int64), np.empty((len(tracks.images), 3))
    for row, mine in rows_of_each(tracks.images):
        image = reconstruction.image(row + 1)
        camera_of[mine] = image.camera_id
        points[mine] = image.cam_from_world() * tracks.points[tracks.point_rows[mine]]
    return camera_of, points


def _tracks(path: Path) -> Tracks:
    content = path.read_bytes()
    (count,) = COUNT.unpack_from(content)
    heads, tracks, at = [], [], COUNT.size
    for _ in range(count):
        track = at + POINT.itemsize
        heads.append(content[at:track])
        at = track + ELEMENT.itemsize * COUNT.unpack_from(content, track - COUNT.size)[0]
        tracks.append(content[track:at])
    if at > len(content):
        raise struct.error(f"{path.name} ends within a track")
    points = np.frombuffer(b"".join(heads), POINT)
    elements = np.frombuffer(b"".join(tracks), ELEMENT)
    del content, heads, tracks
    order = np.argsort(points["id"])
    lengths = points["length"].astype(np.int64)
    ends = np.cumsum(lengths)
    sorted_lengths = lengths[order]
    shifts = (ends - lengths)[order] - (np.cumsum(sorted_lengths) - sorted_lengths)
    elements = elements[np.repeat(shifts, sorted_lengths) + np.arange(len(elements))]
    return Tracks(
        points["id"][order].astype(np.int64),
        points["xyz"][order],
        np.repeat(np.arange(len(points)), sorted_lengths),
        elements["image"].astype(np.int64) - 1,
        elements["keypoint"].astype(np.int64),
    )


def _pixels(path: Path, tracks: Tracks) -> Array:
    pixels = np.empty((len(tracks.images), 2))
    of_image = dict(rows_of_each(tracks.images))
    for image_id, keypoints in _keypoints_of_images(path):
        mine = of_image.get(image_id - 1, slice(0))
        pixels[mine] = keypoints[tracks.rows[mine]]
    return pixels


def _keypoints_of_images(path: Path) -> Iterator[tuple[int, Array]]:
    with path.open("rb") as file:
        for _ in range(COUNT.unpack(file.read(COUNT.size))[0]):
            image_id, _, count = read_image_head(file)
            content = file.read(count * KEYPOINT.itemsize)
            if len(content) < count * KEYPOINT.itemsize:
                raise struct.error(f"{path.name} ends within the keypoints of an image")
            yield image_id, np.frombuffer(content, KEYPOINT)["xy"]
