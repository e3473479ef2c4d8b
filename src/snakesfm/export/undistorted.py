"""Images without distortion, and the model that belongs to them."""

import shutil
from pathlib import Path

from snakesfm.geometry.colmap_binding import pycolmap


def write_undistorted(target: Path, sparse: Path, images: Path, threads: int) -> None:
    """Write ``target``/images and ``target``/sparse/0 with PINHOLE cameras, for tools that know no other.

    Parameters
    ----------
    target : folder to make.
    sparse : folder of the COLMAP model.
    images : folder of the upright images, by the model's names.
    threads : how many images to work on at once.
    """
    pycolmap.undistort_images(str(target), str(sparse), str(images), num_threads=threads)
    flat = target / "sparse"
    model = target / "model"
    flat.rename(model)
    flat.mkdir()
    model.rename(flat / "0")
    shutil.rmtree(target / "stereo")
    for script in target.glob("run-colmap-*.sh"):
        script.unlink()
