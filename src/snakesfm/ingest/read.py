"""Image files: a quick check of header and end, and the pixels.

Pixels are those that the file stores: an EXIF orientation is read, but never applied. COLMAP, 3DGS and
nerfstudio load the linked images in just this way (pycolmap.Bitmap and PIL ignore the tag), intrinsics
belong to the sensor's own grid, and portrait and landscape photographs of one camera share them.
"""

import errno
import hashlib
import mmap
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from PIL import (
    BmpImagePlugin,  # noqa: F401 - naming the plugins spares PIL the import of its fifty others
    ExifTags,
    Image,
    JpegImagePlugin,  # noqa: F401
    MpoImagePlugin,  # noqa: F401
    PngImagePlugin,  # noqa: F401
    TiffImagePlugin,  # noqa: F401
    UnidentifiedImageError,
    WebPImagePlugin,  # noqa: F401
)

from snakesfm.arrays import Array
from snakesfm.errors import ImageError, SceneError, UnreadableImageError
from snakesfm.geometry.orientations import store_pixels
from snakesfm.ingest.exif import Exif, read_exif

# a JPEG that holds several pictures is opened as JPEG and then calls itself MPO
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")
MINIMUM_SIDE_PX = 32
# far beyond any camera, and still read in a few GB
MAXIMUM_PIXELS = 1 << 30
# as PIL's decoders say it, in an OSError
PIL_OUT_OF_MEMORY = "out of memory"
# what stands for no value in pictures of floating-point numbers
NO_VALUES = (-9999.0, -32767.0, -32768.0)
# fewer of the 256 gray levels leave a picture without detail
FEW_LEVELS = 32
MANY_VALUES = 1_000_000
# the bound above takes the place of PIL's, which refuses aerial photographs
Image.MAX_IMAGE_PIXELS = None


@dataclass(frozen=True)
class ImageHeader:
    """What a file says of its image: size as stored, in pixels, and EXIF."""

    width: int
    height: int
    exif: Exif


@dataclass(frozen=True)
class ImagePixels:
    """An image as stored, or reduced: ``gray`` (H,W) uint8 and ``rgb`` (H,W,3) uint8.

    Pixel x, y of the file is x / ``reduction``, y / ``reduction`` here, exactly: whole blocks of pixels
    were reduced to one, and the last column and row may stand for blocks that end outside the file's image.
    """

    gray: Array
    rgb: Array
    reduction: int = 1


def read_header(path: Path | str) -> ImageHeader:
    """Read size and EXIF, and check that the file goes on to its end, without decoding it.

    Raises
    ------
    UnreadableImageError : the file is missing, or the system cannot read it.
    ImageError : it is empty, no image, cut off, or its image is too small or too large.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            _check_not_empty(path, os.fstat(file.fileno()).st_size)
            with _content(file) as data, _open(path, file) as image:
                _check_end(path, image, data)
                width, height = _stored_size(image)
                return ImageHeader(width, height, read_exif(image))
    except OSError as error:
        raise _unreadable(path, error) from None


def read_image(path: Path | str, shorter_side_px: int | None = None, sha256: str = "") -> ImagePixels:
    """Read the pixels as stored, whatever the file's colour space and depth.

    Deeper than 8 bit: the brightest value decides which bits are kept, so 12-bit data in a 16-bit file is
    not dark. Alpha: composed over black. Several pages or frames: the first.

    Parameters
    ----------
    path : the file.
    shorter_side_px : a large JPEG may be decoded at 1/2, 1/4 or 1/8, as long as its shorter side stays at
        least this; that takes a fraction of the time. None for full size.
    sha256 : what the index of images says of the file, hexadecimal; "" where nothing is known of it.

    Raises
    ------
    ImageError : as :func:`read_header`, or the pixels cannot be decoded to the last.
    SceneError : the file's SHA-256 is another than ``sha256``, or the system cannot read the file now.
    """
    path = Path(path)
    data = _read_bytes(path, sha256)
    with _decoding(path, data) as image:
        if image.format in ("JPEG", "MPO") and image.mode in ("RGB", "L"):
            return _decode_jpeg(data, min(image.size), shorter_side_px)
        values = _decode_stored(data, image)
        if values.dtype != np.uint8:
            values = _to_8_bit(values)
        return _from_gray(values) if values.ndim == 2 else _from_rgb(values)


def read_not_black(path: Path | str) -> Array:
    """Where an image as stored is not black, (H,W) bool, be it by one of many gray levels in one colour.

    Alpha is composed over black, and what stands for no value is black, as in :func:`read_image`.

    Raises
    ------
    ImageError : as :func:`read_image`.
    """
    data = _read_bytes(Path(path), "")
    with _decoding(Path(path), data) as image:
        lit = _decode_stored(data, image) > 0
        return np.asarray(lit if lit.ndim == 2 else lit.any(axis=2))


def scale_down(pixels: Array, shorter_side_px: int) -> Array:
    """An image (H,W) or (H,W,3) whose shorter side is at most so many pixels; itself where it is small."""
    height, width = pixels.shape[:2]
    factor = shorter_side_px / min(height, width)
    if factor >= 1:
        return pixels
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    small: Array = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return small


def _read_bytes(path: Path, sha256: str) -> bytes:
    """The content of a file, which has this SHA-256 if one is known."""
    try:
        data = path.read_bytes()
    except OSError as error:
        if not sha256:
            raise _unreadable(path, error) from None
        raise SceneError(
            f"{path} could not be read ({error.strerror}), though it could when the images were indexed: "
            "start the same command again."
        ) from None
    if sha256 and hashlib.sha256(data).hexdigest() != sha256:
        raise SceneError(f"{path} was changed after the images were indexed: start the same command again.")
    _check_not_empty(path, len(data))
    return data


def _content(file: BinaryIO) -> AbstractContextManager[bytes | mmap.mmap]:
    """What a file holds, of which only the end is read where its file system maps files."""
    try:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError:
        return nullcontext(file.read())


def _check_not_empty(path: Path, size: int) -> None:
    if size == 0:
        raise ImageError(f"{path} is empty: replace it by an intact copy or remove it.")


def _unreadable(path: Path, error: OSError) -> UnreadableImageError:
    """What the system's refusal to read a file means for its user."""
    if isinstance(error, IsADirectoryError):
        return UnreadableImageError(f"{path} is a folder, not an image: rename or remove it.")
    if isinstance(error, FileNotFoundError) or error.errno == errno.ELOOP:
        return UnreadableImageError(f"{path} does not exist or is a broken link: restore or remove it.")
    if isinstance(error, PermissionError):
        return UnreadableImageError(f"{path} cannot be read: correct its permissions or remove it.")
    return UnreadableImageError(f"{path} cannot be read ({error.strerror or error}): restore or remove it.")


def _damaged(path: Path, error: Exception) -> Exception:
    """What an error of PIL or OpenCV means; too little memory for a file says nothing of the file."""
    no_room = isinstance(error, cv2.error) and error.code == cv2.Error.StsNoMem
    if isinstance(error, MemoryError) or no_room or PIL_OUT_OF_MEMORY in str(error):
        return MemoryError(f"{path}: {error}")
    return ImageError(f"{path} is damaged ({error}): replace it by an intact copy or remove it.")


def _open(path: Path, file: BinaryIO) -> Image.Image:
    # as in _decoding, the last except takes whatever PIL raises
    try:
        image = Image.open(file, formats=FORMATS)
    except UnidentifiedImageError:
        raise ImageError(
            f"{path} is not a JPEG, PNG, TIFF, WebP or BMP image: convert it to one of these or remove it."
        ) from None
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        raise _damaged(path, error) from error
    width, height = image.size
    if min(width, height) < MINIMUM_SIDE_PX:
        image.close()
        raise ImageError(
            f"{path} has only {width} x {height} pixels, but each side needs {MINIMUM_SIDE_PX}: remove it."
        )
    if width * height > MAXIMUM_PIXELS:
        image.close()
        raise ImageError(f"{path} has {width} x {height} pixels, which is too large: scale it down.")
    return image


@contextmanager
def _decoding(path: Path, data: bytes) -> Iterator[Image.Image]:
    """The checked image in a file's content; what goes wrong with it is an ImageError."""
    with _open(path, BytesIO(data)) as image:
        _check_end(path, image, data)
        try:
            yield image
        # PIL raises errors of every type on damaged files, and one bad image must not stop the others
        except Exception as error:
            raise _damaged(path, error) from error


def _check_end(path: Path, image: Image.Image, data: bytes | mmap.mmap) -> None:
    complete = True
    if image.format in ("JPEG", "MPO"):
        complete = _jpeg_is_complete(data)
    elif image.format == "PNG":
        complete = data.rfind(b"IEND") >= 0
    elif image.format == "WEBP":
        complete = len(data) >= 8 + int.from_bytes(data[4:8], "little")
    elif image.format == "TIFF":
        complete = _tiff_is_complete(image, len(data))
    if not complete:
        raise ImageError(f"{path} is truncated: replace it by an intact copy or remove it.")


def _jpeg_is_complete(data: bytes | mmap.mmap) -> bool:
    """Whether an end marker follows the start of the scan; a thumbnail in the header has its own."""
    if data[-2:] == b"\xff\xd9":
        return True
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:
            place += 1
        elif marker == 0xDA:
            return data.find(b"\xff\xd9", place) >= 0
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return False


def _tiff_is_complete(image: Image.Image, size: int) -> bool:
    tags = _tiff_tags(image)
    for offsets, counts in ((273, 279), (324, 325)):
        starts, lengths = (np.atleast_1d(tags.get(tag, ())) for tag in (offsets, counts))
        if len(starts) == len(lengths) and np.any(starts + lengths > size):
            return False
    return True


def _tiff_tags(image: Image.Image) -> Any:
    return getattr(image, "tag_v2", {}) if image.format == "TIFF" else {}


def _tiff_orientation(image: Image.Image) -> int:
    return int(_tiff_tags(image).get(ExifTags.Base.Orientation, 1))


def _stored_size(image: Image.Image) -> tuple[int, int]:
    tags = _tiff_tags(image)
    width = tags.get(ExifTags.Base.ImageWidth, image.width)
    return int(width), int(tags.get(ExifTags.Base.ImageLength, image.height))


def _decode_jpeg(data: bytes, side: int, shorter_side_px: int | None) -> ImagePixels:
    """Decode an 8-bit gray or colour JPEG with OpenCV: PIL's very pixels, with a copy less."""
    reduction = 1
    while shorter_side_px and reduction < 8 and side // (2 * reduction) >= shorter_side_px:
        reduction *= 2
    flags = {
        1: cv2.IMREAD_COLOR_BGR,
        2: cv2.IMREAD_REDUCED_COLOR_2,
        4: cv2.IMREAD_REDUCED_COLOR_4,
        8: cv2.IMREAD_REDUCED_COLOR_8,
    }[reduction]
    return _from_rgb(cv2.cvtColor(_decode(data, flags), cv2.COLOR_BGR2RGB), reduction)


def _decode(data: bytes, flags: int) -> Array:
    """Colours (H,W,3) or (H,W,4) in OpenCV's order, turned where a TIFF file asks for it."""
    colours = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if colours is None:
        raise ValueError("it cannot be decoded")
    return np.asarray(colours)


def _layout_of_deep_colours(image: Image.Image) -> str:
    """What PIL calls the file's order of colours of 16 bits, which it would cut to their upper 8, or ''."""
    if image.mode not in ("RGB", "RGBA"):
        return ""
    return next((str(tile[3]) for tile in image.tile if ";16" in str(tile[3])), "")


def _decode_stored(data: bytes, image: Image.Image) -> Array:
    """Gray (H,W) or colours (H,W,3) of an opened image in the file's depth, alpha composed over black."""
    # PIL applies the orientation of TIFF files, and only of these
    orientation = _tiff_orientation(image)
    # loading drops what tells the depth, but no damage passes it
    layout = _layout_of_deep_colours(image)
    # colours of RGBa are multiplied by alpha already
    transparent = image.has_transparency_data and "RGBa" not in layout
    image.load()
    values = _decode_deep(data, transparent) if layout else _decoded_values(image)
    return store_pixels(values, orientation)


def _decode_deep(data: bytes, transparent: bool) -> Array:
    """Colours (H,W,3) of 16 bits, turned as PIL turns them; ``transparent``: over black."""
    colours = _decode(data, cv2.IMREAD_UNCHANGED)
    rgb = colours[..., 2::-1]
    if transparent:
        rgb = rgb.astype(np.uint32) * colours[..., 3:] // np.iinfo(colours.dtype).max
    return rgb


def _decoded_values(image: Image.Image) -> Array:
    if image.mode.startswith(("I", "F")):
        return np.asarray(image)
    if image.has_transparency_data:
        rgba = image if image.mode == "RGBA" else image.convert("RGBA")
        black = Image.new("RGBA", rgba.size, (0, 0, 0, 255))
        return np.asarray(Image.alpha_composite(black, rgba).convert("RGB"))
    return np.asarray(image.convert("L" if image.mode in ("1", "L") else "RGB"))


def _from_gray(gray: Array) -> ImagePixels:
    return ImagePixels(gray, cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB))


def _from_rgb(rgb: Array, reduction: int = 1) -> ImagePixels:
    return ImagePixels(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), rgb, reduction)


def _to_8_bit(values: Array) -> Array:
    """Gray values (H,W) or colours (H,W,3) of any type to uint8.

    Of integers the upper bits in use, as of cameras of 10 to 16 bits. Numbers that would take few gray
    levels so, as of thermal cameras or beside one hot pixel, and floating-point ones are stretched: nearly
    all of them to all levels. What stands for no value counts as the darkest.
    """
    void = ~np.isfinite(values) | np.isin(values, NO_VALUES)
    some = values[~void].ravel()
    some = some[:: max(1, len(some) // MANY_VALUES)]
    if not len(some):
        return np.zeros(values.shape, np.uint8)
    low, high = (float(value) for value in np.percentile(some, (0.1, 99.9)))
    if values.dtype.kind != "f":
        shift = max(int(values.max()).bit_length() - 8, 0)
        if not shift or high == low or high - low >= FEW_LEVELS << shift:
            return (np.maximum(values, 0) >> shift).astype(np.uint8)
    scale = 255.0 / (high - low) if high > low else 0.0
    stretched = np.where(void, 0.0, (np.where(void, low, values) - low) * scale)
    return np.clip(np.round(stretched), 0, 255).astype(np.uint8)
