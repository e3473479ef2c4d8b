"""Images without distortion, and the model and the masks that belong to them."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ImageError
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.geometry.colmap_checks import check_binary
from snakesfm.geometry.colmap_files import lack_of_space
from snakesfm.ingest.masks import find_mask, read_mask

JPEG_SUFFIXES = (".jpg", ".jpeg")
# COLMAP takes less for none, and it moves no pixel by a thousandth
LEAST_DISTORTION = 1e-7
PINHOLE_PARAMETERS = 4
JPEG_END = b"\xff\xd9"
GRID = 50


def write_undistorted(target: Path, sparse: Path, images: Path, masks: Path | None, threads: int) -> None:
    """Write ``target``/images and ``target``/sparse/0 with PINHOLE cameras, for tools that know no other.

    Images and masks of perspective cameras without distortion keep their size and every pixel.

    Parameters
    ----------
    target : folder to make.
    sparse : folder of the COLMAP model.
    images : folder of the images as they are stored, by the model's names.
    masks : folder of masks, which go to ``target``/masks, named as in COLMAP; None without.
    threads : how many images to work on at once.

    Raises
    ------
    ImageError : an image can no longer be read, or has another size than its camera.
    ConfigError : a mask cannot be used.
    OSError : the disk is full.
    """
    model = pycolmap.Reconstruction(str(sparse))
    registered = [model.images[image_id] for image_id in model.reg_image_ids()]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(partial(_check_size, images, model), registered))
    for camera in model.cameras.values():
        _replace_undistorted(camera)
    distorted = target / "distorted"
    distorted.mkdir(parents=True)
    model.write_binary(str(distorted))
    check_binary(distorted, model)
    jpegs = [image.name for image in registered if image.name.lower().endswith(JPEG_SUFFIXES)]
    # of no names COLMAP takes all
    names = jpegs or [image.name for image in registered[:1]]
    pycolmap.undistort_images(str(target), str(distorted), str(images), names, num_threads=threads)
    shutil.rmtree(distorted)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(partial(_write_other, target / "images", images, model), registered))
        if masks is not None:
            list(pool.map(partial(_write_mask, target / "masks", masks, model), registered))
    flat = target / "sparse"
    check_binary(flat, model, PINHOLE_PARAMETERS)
    inner = target / "model"
    flat.rename(inner)
    flat.mkdir()
    inner.rename(flat / "0")
    shutil.rmtree(target / "stereo")
    for script in target.glob("run-colmap-*.sh"):
        script.unlink()


def undistorted_share(camera: Camera) -> float:
    """The share of a camera's picture that is left of it without distortion.

    COLMAP makes it as large as the edges tell. Where a lens sees more than 180 degrees, they have no rays,
    and the picture may become a thumbnail.
    """
    source = camera.to_pycolmap()
    _replace_undistorted(source)
    if source.model_name == "PINHOLE":
        return 1.0
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), source)
    columns, rows = np.meshgrid(
        (np.arange(GRID) + 0.5) * camera.width / GRID, (np.arange(GRID) + 0.5) * camera.height / GRID
    )
    rays = camera.normalize(np.column_stack([columns.ravel(), rows.ravel()]))
    pixels = np.asarray(flat.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    return float(((pixels >= 0) & (pixels <= [flat.width, flat.height])).all(axis=1).mean())


def _replace_undistorted(camera: "pycolmap.Camera") -> None:
    """Make a camera whose distortion is all 0, which COLMAP leaves as it is, PINHOLE or a true fisheye."""
    if not camera.is_undistorted():
        return
    matrix = camera.calibration_matrix()
    pinhole = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    if camera.is_perspective_fisheye():
        camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE
        camera.params = [*pinhole, LEAST_DISTORTION, 0.0, 0.0, 0.0]
    else:
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.params = pinhole


def _check_size(images: Path, model: "pycolmap.Reconstruction", image: "pycolmap.Image") -> None:
    """Refuse an image of another size than its camera, which would end COLMAP without a word."""
    from snakesfm.ingest.read import read_header

    header, camera = read_header(images / image.name), model.cameras[image.camera_id]
    if (header.width, header.height) != (camera.width, camera.height):
        raise ImageError(
            f"{images / image.name} has {header.width} x {header.height} pixels, but its camera "
            f"{camera.width} x {camera.height}: restore the image that the model was made from."
        )


def _write_other(
    target: Path, images: Path, model: "pycolmap.Reconstruction", image: "pycolmap.Image"
) -> None:
    """Write what is no JPEG, whatever its name says, from the pixels that keypoints were found in.

    COLMAP reads no WebP, makes 12 bits in a file of 16 dark, and writes some TIFF files as none can read.
    """
    file = target / image.name
    if image.name.lower().endswith(JPEG_SUFFIXES) and file.is_file():
        _check_end(file, images / image.name)
        return
    # most jobs need no more than JPEG
    from PIL import Image

    from snakesfm.ingest.read import read_image

    options = pycolmap.UndistortCameraOptions()
    camera = model.cameras[image.camera_id]
    pixels = _undistort(read_image(images / image.name).rgb, camera, options)
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file, lossless=True, quality=95)


def _check_end(jpeg: Path, source: Path) -> None:
    """Refuse a JPEG whose end COLMAP had no room for."""
    size = jpeg.stat().st_size
    # what needs no warp is copied, and cameras may append to a JPEG what they like
    if size == source.stat().st_size:
        return
    with jpeg.open("rb") as file:
        file.seek(-min(len(JPEG_END), size), os.SEEK_END)
        if file.read() != JPEG_END:
            raise lack_of_space(jpeg.parent)


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
    file = target / f"{image.name}.png"
    file.parent.mkdir(parents=True, exist_ok=True)
    if not pycolmap.Bitmap.from_array(_undistort(shown, camera, options)).write(str(file)):
        raise lack_of_space(file.parent)


def _undistort(
    pixels: Array, camera: "pycolmap.Camera", options: "pycolmap.UndistortCameraOptions"
) -> Array:
    """Pixels (H,W) or (H,W,3) uint8 without the camera's distortion; themselves of a PINHOLE camera."""
    if camera.model_name == "PINHOLE":
        return pixels
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(pixels), camera)
    undistorted: Array = bitmap.to_array()
    return undistorted
