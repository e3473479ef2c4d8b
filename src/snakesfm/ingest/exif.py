"""Camera data from EXIF: body, lens, focal length and GPS position."""

import functools
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

Triple = tuple[float, float, float]

# CIPA DCG-001: the 35 mm equivalent compares diagonals of the picture
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
# ratio of focal length and longer side: fields of view from 127 down to 2.3 degrees
FOCAL_RATIO_RANGE = (0.25, 25.0)
# sensors are 4:3 or longer; what is squarer or as long as a panorama was cropped or stitched
ASPECT_RANGE = (1.3, 2.4)
ASPECT_TOLERANCE = 0.02
# thermal, multispectral and machine vision cameras have 5:4 and 6:5, action cameras 8:7
SQUAREST_SENSOR = 1.1
NO_PLACE: Triple = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Exif:
    """EXIF of one image; empty text, NaN or 0 where it says nothing.

    Parameters
    ----------
    make, model, lens : names of the camera and its lens.
    focal_mm, focal_35mm : focal length, and its equivalent on 36 x 24 mm.
    width, height : image size in pixels when the photograph was taken, as stored.
    orientation : EXIF orientation tag, 1..8; 1 also where there is none.
    gps : latitude and longitude in degrees, altitude in metres.
    """

    make: str = ""
    model: str = ""
    lens: str = ""
    focal_mm: float = math.nan
    focal_35mm: float = math.nan
    width: int = 0
    height: int = 0
    orientation: int = 1
    gps: Triple = NO_PLACE


def read_exif(image: Image.Image) -> Exif:
    """EXIF of an opened image, without decoding it; what is missing or damaged stays empty."""
    if image.format == "PNG" and "exif" not in image.info:
        # PIL would decode the whole image to look behind its pixels
        return Exif()
    # anyone can write EXIF, so its readers meet every kind of damage; none of it makes the image worse
    try:
        tags = image.getexif()
        camera = tags.get_ifd(ExifTags.IFD.Exif)
        place = tags.get_ifd(ExifTags.IFD.GPSInfo)
    except Exception:
        return Exif()
    orientation = _number(tags.get(ExifTags.Base.Orientation))
    return Exif(
        make=_text(tags.get(ExifTags.Base.Make)),
        model=_text(tags.get(ExifTags.Base.Model)),
        lens=_text(camera.get(ExifTags.Base.LensModel)),
        focal_mm=_positive(camera.get(ExifTags.Base.FocalLength)),
        focal_35mm=_positive(camera.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        width=_pixels(camera.get(ExifTags.Base.ExifImageWidth)),
        height=_pixels(camera.get(ExifTags.Base.ExifImageHeight)),
        orientation=int(orientation) if orientation in range(1, 9) else 1,
        gps=_place(place),
    )


def focal_from_exif(exif: Exif, width: int, height: int) -> float:
    """Focal length in pixels of an image that shows the sensor's whole width; NaN where EXIF does not say.

    The focal length in millimetres over the sensor's width is preferred to the 35 mm equivalent, a rounded
    number; where the equivalent is clearly longer, the camera zoomed digitally or has several lenses.
    """
    longer = max(width, height)
    sensor = sensor_width_mm(exif.make, exif.model) if exif.focal_mm > 0 else math.nan
    by_sensor = exif.focal_mm / sensor * longer
    by_equivalent = exif.focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)
    focal = by_sensor
    if math.isnan(by_sensor) or by_equivalent > 1.1 * by_sensor:
        focal = by_equivalent
    low, high = FOCAL_RATIO_RANGE
    return focal if low <= focal / longer <= high else math.nan


def is_cropped(exif: Exif, width: int, height: int) -> bool:
    """Whether the image's shape tells that it is not the picture that the camera took."""
    aspect = max(width, height) / min(width, height)
    low, high = ASPECT_RANGE
    if not low <= aspect <= high:
        return True
    if min(exif.width, exif.height) <= 0:
        return False
    taken = max(exif.width, exif.height) / min(exif.width, exif.height)
    return abs(aspect / taken - 1) > ASPECT_TOLERANCE


def is_of_stated_size(exif: Exif, width: int, height: int) -> bool:
    """Whether EXIF states an image's very size, and its shape may be a sensor's: 5:4 is, a square is not.

    Programs that crop write the new size into EXIF, so it proves little of a shape that many crop to.
    """
    square = max(width, height) < SQUAREST_SENSOR * min(width, height)
    return not square and {exif.width, exif.height} == {width, height}


@functools.lru_cache(maxsize=4096)
def sensor_width_mm(make: str, model: str) -> float:
    """Sensor width of a camera from COLMAP's database; NaN where it is unknown."""
    if not (make and model):
        return math.nan
    from PIL.TiffImagePlugin import IFDRational

    from snakesfm.geometry.colmap_binding import pycolmap

    # pycolmap answers only for image files, so it is shown a small one that this camera might have taken
    probe = Image.new("RGB", (64, 48))
    tags = Image.Exif()
    tags[ExifTags.Base.Make] = make
    tags[ExifTags.Base.Model] = model
    tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = IFDRational(10, 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "probe.jpg"
        probe.save(path, exif=tags)
        camera = pycolmap.infer_camera_from_image(path)
    if not camera.has_prior_focal_length:
        return math.nan
    return float(10.0 * 64.0 / camera.mean_focal_length())


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return " ".join(value.replace("\0", " ").split()) if isinstance(value, str) else ""


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def _positive(value: Any) -> float:
    number = _number(value)
    return number if 0 < number < math.inf else math.nan


def _pixels(value: Any) -> int:
    number = _positive(value)
    return int(number) if number < 1e6 else 0


def _place(tags: Any) -> Triple:
    latitude = _degrees(tags.get(ExifTags.GPS.GPSLatitude), tags.get(ExifTags.GPS.GPSLatitudeRef), "S")
    longitude = _degrees(tags.get(ExifTags.GPS.GPSLongitude), tags.get(ExifTags.GPS.GPSLongitudeRef), "W")
    # cameras without a fix write 0, 0
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
        return NO_PLACE
    altitude = _number(tags.get(ExifTags.GPS.GPSAltitude))
    below = tags.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
    if not abs(altitude) < 1e5:
        altitude = math.nan
    return latitude, longitude, -altitude if below else altitude


def _degrees(value: Any, reference: Any, negative: str) -> float:
    try:
        parts = [_number(part) for part in value]
    except TypeError:
        return math.nan
    if len(parts) != 3:
        return math.nan
    degrees = parts[0] + parts[1] / 60 + parts[2] / 3600
    # some programs write the word
    return -degrees if _text(reference)[:1].upper() == negative else degrees
