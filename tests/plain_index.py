"""An index of images that nothing is known of but their sizes."""

import numpy as np

from snakesfm.artifacts import Header, ImageIndex
from snakesfm.geometry.camera import PARAM_SLOTS


def write_plain_index(path, names, sizes, sha256):
    """Write the index of images (N names, sizes and digests) without cameras, EXIF or refused files."""
    count = len(names)
    columns = {"orientations": 1, "duplicate_of": -1, "blocks": 0, "camera_ids": 0}
    ImageIndex(
        names=names,
        sizes=np.array(sizes),
        sha256=sha256,
        focal_exif_px=np.full(count, np.nan),
        gps=np.full((count, 3), np.nan),
        camera_models=[],
        camera_sizes=np.zeros((0, 2), int),
        camera_params=np.zeros((0, PARAM_SLOTS)),
        camera_sources=[],
        refused_names=[],
        refused_reasons=[],
        warnings=[],
        **{name: np.full(count, value) for name, value in columns.items()},
    ).write(path, Header("test", 1, "scene"))
