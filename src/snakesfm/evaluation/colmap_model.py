"""Poses of a COLMAP model on disk, whichever version of COLMAP wrote it."""

from pathlib import Path

import numpy as np

from snakesfm.errors import ConfigError
from snakesfm.evaluation.metrics import Poses
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.given_files import NO_MODEL, find_model_folder


def find_model(folder: Path) -> Path:
    """The folder with cameras, images and points3D files: ``folder`` or its sparse/0, sparse or 0.

    Raises
    ------
    ConfigError : none of them holds a COLMAP model.
    """
    place = find_model_folder(folder)
    if place is None:
        raise ConfigError(f"{folder} {NO_MODEL}")
    return place


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """A COLMAP model, binary or text.

    Raises
    ------
    ConfigError : there is none, or its files cannot be read.
    """
    place = find_model(folder)
    try:
        model = pycolmap.Reconstruction(str(place))
        if not (place / "images.bin").is_file():
            _restore_names(model, place / "images.txt")
        return model
    except Exception as error:  # pycolmap raises what its file parser happens to raise
        reason = str(error).strip().splitlines()[-1:] or ["unreadable"]
        raise ConfigError(
            f"The COLMAP model in {place} cannot be read ({reason[0]}): write it again."
        ) from None


def _restore_names(model: pycolmap.Reconstruction, path: Path) -> None:
    """Give images their whole names: COLMAP's text reader cuts them at the first space."""
    with path.open(encoding="utf-8") as file:
        for line in file:
            fields = line.split(maxsplit=9)
            if not fields or line.startswith("#"):
                continue
            model.images[int(fields[0])].name = fields[9].rstrip("\r\n")
            next(file, None)


def model_poses(model: pycolmap.Reconstruction) -> Poses:
    """The registered images of a model, sorted by name."""
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda image: image.name
    )
    poses = [image.cam_from_world() for image in images]
    return Poses(
        [image.name for image in images],
        np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3),
        np.array([pose.translation for pose in poses]).reshape(-1, 3),
    )
