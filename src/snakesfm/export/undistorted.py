"""Images without distortion, and the cameras and masks that belong to them."""

import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from snakesfm.arrays import Array
from snakesfm.errors import ImageError
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.ingest.masks import find_mask, read_mask

if TYPE_CHECKING:
    from PIL.Image import Image

# COLMAP takes less for none, and it moves no pixel by a thousandth
LEAST_DISTORTION = 1e-7
# of a principal point from the middle, in pixels
MOST_OFF_MIDDLE = 0.5
GRID = 50
JPEG_FORMATS = ("JPEG", "MPO")
# that PIL writes
MOST_EXIF_BYTES = 65533
# of JPEG, as COLMAP's, and for how long PIL looks for a smaller WebP
JPEG_QUALITY, WEBP_EFFORT = 100, 95


@dataclass(frozen=True)
class FlatCamera:
    """A camera's picture without distortion, cropped so that the principal point is in its middle.

    Inria's 3DGS takes it to be there, whatever the model says.

    Parameters
    ----------
    lens : of the image as it is stored; PINHOLE if it has no distortion.
    camera : PINHOLE, of the cropped picture.
    left, top : columns and rows that are cut off before it.
    cropped : share of the pixels of the picture without distortion that are cut off.
    shown : share of the image that the picture without distortion holds.
    """

    lens: Camera
    camera: Camera
    left: int
    top: int
    cropped: float
    shown: float

    @property
    def is_whole(self) -> bool:
        """Whether the image as it is stored is the picture."""
        return self.lens.model == "PINHOLE" and not self.cropped

    def move(self, keypoints: Array) -> Array:
        """Pixels (N,2) of the stored image in the picture, NaN where it holds none."""
        fx, fy, cx, cy = self.camera.params
        moved: Array = self.lens.normalize(keypoints) * (fx, fy) + (cx, cy)
        return moved

    def show(self, pixels: Array, nearest: bool = False) -> Array:
        """The picture (H,W) or (H,W,3) uint8 of a stored image, of four pixels or the ``nearest``."""
        if self.lens.model != "PINHOLE":
            options = pycolmap.UndistortCameraOptions()
            if nearest:
                interpolations = type(options.warp_options.interpolation)
                options.warp_options.interpolation = interpolations.NEAREST_NEIGHBOR
            stored = pycolmap.Bitmap.from_array(pixels)
            pixels = pycolmap.undistort_image(options, stored, self.lens.to_pycolmap())[0].to_array()
        rows = slice(self.top, self.top + self.camera.height)
        return pixels[rows, self.left : self.left + self.camera.width]


def flatten(camera: Camera) -> FlatCamera:
    """The picture of a camera without distortion.

    COLMAP makes it as large as the edges tell. Where a lens sees more than 180 degrees, they have no rays,
    and the picture may become a thumbnail.
    """
    lens = _true_lens(camera)
    whole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens.to_pycolmap())
    left, width = _middle_part(whole.principal_point_x, whole.width)
    top, height = _middle_part(whole.principal_point_y, whole.height)
    focals = (whole.focal_length_x, whole.focal_length_y)
    params = (*focals, whole.principal_point_x - left, whole.principal_point_y - top)
    cropped = 1.0 - width * height / (whole.width * whole.height)
    return FlatCamera(
        lens, Camera("PINHOLE", width, height, params), left, top, cropped, _share(lens, whole)
    )


def _true_lens(camera: Camera) -> Camera:
    """A camera whose distortion is all 0, which COLMAP leaves as it is, as PINHOLE or a true fisheye."""
    source = camera.to_pycolmap()
    if not source.is_undistorted():
        return camera
    matrix = source.calibration_matrix()
    pinhole = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    if source.is_perspective_fisheye():
        terms = (LEAST_DISTORTION, 0.0, 0.0, 0.0)
        return Camera("OPENCV_FISHEYE", camera.width, camera.height, pinhole + terms)
    return Camera("PINHOLE", camera.width, camera.height, pinhole)


def _middle_part(principal: float, size: int) -> tuple[int, int]:
    """Start and length of the longest part of a side that has the principal point in its middle."""
    if abs(principal - size / 2) <= MOST_OFF_MIDDLE:
        return 0, size
    # of a camera that looks past its picture, next to nothing
    length = max(1, round(2 * min(principal, size - principal)))
    return (0 if principal < size / 2 else size - length), length


def _share(lens: Camera, whole: pycolmap.Camera) -> float:
    """The share of a lens's image that is in its ``whole`` picture without distortion."""
    if lens.model == "PINHOLE":
        return 1.0
    columns, rows = np.meshgrid(
        (np.arange(GRID) + 0.5) * lens.width / GRID, (np.arange(GRID) + 0.5) * lens.height / GRID
    )
    rays = lens.normalize(np.column_stack([columns.ravel(), rows.ravel()]))
    pixels = np.asarray(whole.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    return float(((pixels >= 0) & (pixels <= [whole.width, whole.height])).all(axis=1).mean())


def write_undistorted(
    target: Path, images: Path, masks: Path | None, cameras: Mapping[str, FlatCamera], threads: int
) -> None:
    """Write the pictures to ``target``/images, and their masks to ``target``/masks, named as in COLMAP.

    Parameters
    ----------
    target : folder to make.
    images : folder of the images as they are stored.
    masks : folder of masks; None without.
    cameras : of each image, by its name.
    threads : how many images to work on at once.

    Raises
    ------
    ImageError : an image can no longer be read, or has another size than its camera.
    ConfigError : a mask cannot be used.
    OSError : the disk is full.
    """

    def write(name: str) -> None:
        camera = cameras[name]
        _check_size(images / name, camera.lens)
        _write_image(images / name, target / "images" / name, camera)
        mask = None if masks is None else find_mask(masks, name)
        if mask is not None:
            _write_mask(mask, target / "masks" / f"{name}.png", camera)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(write, cameras))


def _check_size(image: Path, lens: Camera) -> None:
    """Refuse an image of another size than its camera."""
    from snakesfm.ingest.read import read_header

    header = read_header(image)
    if (header.width, header.height) != (lens.width, lens.height):
        raise ImageError(
            f"{image} has {header.width} x {header.height} pixels, but its camera "
            f"{lens.width} x {lens.height}: restore the image that the model was made from."
        )


def _write_image(source: Path, place: Path, camera: FlatCamera) -> None:
    """Write the picture of an image, from the pixels that keypoints were found in."""
    from PIL import Image

    from snakesfm.ingest.read import read_image

    place.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(source) as opened:
        # of other formats, some tools read no WebP, and 12 bits in a file of 16 as dark
        is_copied = camera.is_whole and opened.format in JPEG_FORMATS
        options = _kept(opened)
    if is_copied:
        shutil.copyfile(source, place)
        return
    kind = Image.registered_extensions()[place.suffix.lower()]
    options["quality"] = JPEG_QUALITY if kind == "JPEG" else WEBP_EFFORT
    content = BytesIO()
    Image.fromarray(camera.show(read_image(source).rgb)).save(content, kind, lossless=True, **options)
    # by Python, which tells a full disk
    place.write_bytes(content.getvalue())


def _kept(image: "Image") -> dict[str, Any]:
    """What the picture of a JPEG image keeps of it: EXIF, colour profile, how finely it samples colours."""
    from PIL import JpegImagePlugin

    if image.format not in JPEG_FORMATS:
        return {}
    kept: dict[str, Any] = {"subsampling": JpegImagePlugin.get_sampling(image)}
    exif = image.info.get("exif", b"")
    if len(exif) <= MOST_EXIF_BYTES:
        kept["exif"] = exif
    if image.mode == "RGB":
        kept["icc_profile"] = image.info.get("icc_profile")
    return kept


def _write_mask(source: Path, place: Path, camera: FlatCamera) -> None:
    """Write a mask as the picture of its image is; it knows no gray."""
    size = camera.lens.width, camera.lens.height
    wanted = 255 * read_mask(source, size).astype(np.uint8)
    wanted = cv2.resize(wanted, size, interpolation=cv2.INTER_NEAREST)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(cv2.imencode(".png", camera.show(wanted, nearest=True))[1].tobytes())
