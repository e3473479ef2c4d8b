"""Images without distortion, and the model and the masks that belong to them."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.ingest.masks import find_mask, read_mask

JPEG_SUFFIXES = (".jpg", ".jpeg")


def write_undistorted(target: Path, sparse: Path, images: Path, masks: Path | None, threads: int) -> None:
    """Write ``target``/images and ``target``/sparse/0 with PINHOLE cameras, for tools that know no other.

    Parameters
    ----------
    target : folder to make.
    sparse : folder of the COLMAP model.
    images : folder of the images as they are stored, by the model's names.
    masks : folder of masks, which go to ``target``/masks, named as in COLMAP; None without.
    threads : how many images to work on at once.

    Raises
    ------
    ImageError : an image can no longer be read.
    ConfigError : a mask cannot be used.
    """
    model = pycolmap.Reconstruction(str(sparse))
    registered = [model.images[image_id] for image_id in model.reg_image_ids()]
    jpegs = [image.name for image in registered if image.name.lower().endswith(JPEG_SUFFIXES)]
    # of no names COLMAP takes all
    names = jpegs or [image.name for image in registered[:1]]
    pycolmap.undistort_images(str(target), str(sparse), str(images), names, num_threads=threads)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(partial(_write_other, target / "images", images, model), registered))
        if masks is not None:
            list(pool.map(partial(_write_mask, target / "masks", masks, model), registered))
    flat = target / "sparse"
    model = target / "model"
    flat.rename(model)
    flat.mkdir()
    model.rename(flat / "0")
    shutil.rmtree(target / "stereo")
    for script in target.glob("run-colmap-*.sh"):
        script.unlink()


def _write_other(
    target: Path, images: Path, model: "pycolmap.Reconstruction", image: "pycolmap.Image"
) -> None:
    """Write what is no JPEG, whatever its name says, from the pixels that keypoints were found in.

    COLMAP reads no WebP, makes 12 bits in a file of 16 dark, and writes some TIFF files as none can read.
    """
    file = target / image.name
    if image.name.lower().endswith(JPEG_SUFFIXES) and file.is_file():
        return
    # most jobs need no more than JPEG
    from PIL import Image

    from snakesfm.ingest.read import read_image

    pixels = pycolmap.Bitmap.from_array(read_image(images / image.name).rgb)
    camera = model.cameras[image.camera_id]
    bitmap, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), pixels, camera)
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(bitmap.to_array()).save(file, lossless=True, quality=95)


def _write_mask(
    target: Path, masks: Path, model: "pycolmap.Reconstruction", image: "pycolmap.Image"
) -> None:
    """Undistort the mask of an image that has one, as the image is."""
    mask = find_mask(masks, image.name)
    if mask is None:
        return
    options = pycolmap.UndistortCameraOptions()
    # a mask knows no gray
    nearest = type(options.warp_options.interpolation).NEAREST_NEIGHBOR
    options.warp_options.interpolation = nearest
    camera = model.cameras[image.camera_id]
    size = camera.width, camera.height
    shown = 255 * read_mask(mask, size).astype(np.uint8)
    shown = cv2.resize(shown, size, interpolation=cv2.INTER_NEAREST)
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(shown), camera)
    file = target / f"{image.name}.png"
    file.parent.mkdir(parents=True, exist_ok=True)
    bitmap.write(str(file))
