import math

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from snakesfm.ingest.exif import Exif, focal_from_exif, is_cropped, read_exif, sensor_width_mm


def write(path, base=None, camera=None, place=None, size=(300, 200)):
    tags = Image.Exif()
    tags.update(base or {})
    tags.get_ifd(ExifTags.IFD.Exif).update(camera or {})
    tags.get_ifd(ExifTags.IFD.GPSInfo).update(place or {})
    Image.new("RGB", size).save(path, exif=tags.tobytes())
    with Image.open(path) as image:
        return read_exif(image)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp"])
def test_reads_camera_and_focal_lengths(tmp_path, name):
    exif = write(
        tmp_path / name,
        {ExifTags.Base.Make: " NIKON \0", ExifTags.Base.Model: "NIKON  D750", ExifTags.Base.Orientation: 6},
        {
            ExifTags.Base.FocalLength: IFDRational(240, 10),
            ExifTags.Base.FocalLengthIn35mmFilm: 24,
            ExifTags.Base.LensModel: "24-120mm f/4",
            ExifTags.Base.ExifImageWidth: 6016,
            ExifTags.Base.ExifImageHeight: 4016,
        },
    )
    assert (exif.make, exif.model, exif.lens) == ("NIKON", "NIKON D750", "24-120mm f/4")
    assert (exif.focal_mm, exif.focal_35mm) == (24.0, 24.0)
    assert (exif.width, exif.height, exif.orientation) == (6016, 4016, 6)


def test_place_with_signs(tmp_path):
    south_west = {
        ExifTags.GPS.GPSLatitudeRef: "S",
        ExifTags.GPS.GPSLatitude: (IFDRational(33), IFDRational(30), IFDRational(18)),
        ExifTags.GPS.GPSLongitudeRef: "W",
        ExifTags.GPS.GPSLongitude: (IFDRational(70), IFDRational(45), IFDRational(0)),
        ExifTags.GPS.GPSAltitudeRef: b"\x01",
        ExifTags.GPS.GPSAltitude: IFDRational(125, 10),
    }
    np.testing.assert_allclose(write(tmp_path / "a.jpg", place=south_west).gps, (-33.505, -70.75, -12.5))
    words = south_west | {ExifTags.GPS.GPSLatitudeRef: "South", ExifTags.GPS.GPSLongitudeRef: " west"}
    np.testing.assert_allclose(write(tmp_path / "w.jpg", place=words).gps, (-33.505, -70.75, -12.5))
    nowhere = south_west | {
        ExifTags.GPS.GPSLatitude: (IFDRational(0),) * 3,
        ExifTags.GPS.GPSLongitude: (IFDRational(0),) * 3,
    }
    assert np.isnan(write(tmp_path / "b.jpg", place=nowhere).gps).all()
    del south_west[ExifTags.GPS.GPSAltitude]
    assert np.isnan(write(tmp_path / "c.jpg", place=south_west).gps).tolist() == [False, False, True]


def test_damaged_values_are_nothing(tmp_path):
    exif = write(
        tmp_path / "a.jpg",
        {ExifTags.Base.Model: "X", ExifTags.Base.Orientation: 77},
        {ExifTags.Base.FocalLength: IFDRational(0, 0), ExifTags.Base.FocalLengthIn35mmFilm: 0},
        {ExifTags.GPS.GPSLatitude: (IFDRational(1, 0),) * 3},
    )
    assert exif.orientation == 1
    assert math.isnan(exif.focal_mm)
    assert math.isnan(exif.focal_35mm)
    assert np.isnan(exif.gps).all()
    path = tmp_path / "b.jpg"
    Image.new("RGB", (64, 64)).save(path, exif=b"Exif\0\0" + bytes(range(200)))
    with Image.open(path) as image:
        assert read_exif(image).model == ""


def test_sensor_database():
    assert sensor_width_mm("NIKON", "NIKON D750") == pytest.approx(35.9, abs=0.05)
    assert sensor_width_mm("DJI", "FC6310") == pytest.approx(13.2, abs=0.05)
    assert math.isnan(sensor_width_mm("Nobody", "カメラ"))
    assert math.isnan(sensor_width_mm("", "NIKON D750"))


@pytest.mark.parametrize(
    ("exif", "size", "ratio"),
    [
        (Exif("NIKON", "NIKON D750", focal_mm=50), (6016, 4016), 50 / 35.9),
        (Exif("NIKON", "NIKON D750", focal_mm=50), (4016, 6016), 50 / 35.9),
        # the rounded equivalent only decides where the sensor is unknown
        (Exif("NIKON", "NIKON D750", focal_mm=50, focal_35mm=52), (6016, 4016), 50 / 35.9),
        (Exif("", "", focal_35mm=36), (6000, 4000), 1.0),
        (Exif("", "", focal_35mm=35), (4000, 3000), 35 * 1.25 / math.hypot(36, 24)),
        # digital zoom, or the longer lens of a telephone
        (Exif("NIKON", "NIKON D750", focal_mm=50, focal_35mm=100), (6000, 4000), 100 / 36),
        (Exif("NIKON", "NIKON D750", focal_mm=50, focal_35mm=65), (6000, 4000), 65 / 36),
        (Exif("NIKON", "NIKON D750", focal_mm=50, focal_35mm=53), (6000, 4000), 50 / 35.9),
        # an equivalent that merely repeats the focal length
        (Exif("DJI", "FC6310", focal_mm=8.8, focal_35mm=9), (5472, 3648), 8.8 / 13.2),
    ],
)
def test_focal_length(exif, size, ratio):
    assert focal_from_exif(exif, *size) / max(size) == pytest.approx(ratio, rel=2e-3)


@pytest.mark.parametrize(
    "exif", [Exif(), Exif("Nobody", "X", focal_mm=5), Exif(focal_35mm=2), Exif(focal_35mm=3000)]
)
def test_no_or_absurd_focal_length(exif):
    assert math.isnan(focal_from_exif(exif, 4000, 3000))


@pytest.mark.parametrize(
    ("exif", "size", "cropped"),
    [
        (Exif(), (4000, 3000), False),
        (Exif(), (1011, 760), False),
        (Exif(), (1080, 1920), False),
        (Exif(), (3024, 4032), False),
        (Exif(), (760, 760), True),
        (Exif(), (9000, 2000), True),
        (Exif(width=4000, height=3000), (2000, 1500), False),
        (Exif(width=4000, height=3000), (1500, 2000), False),
        (Exif(width=4000, height=3000), (2000, 1333), True),
    ],
)
def test_cropped(exif, size, cropped):
    assert is_cropped(exif, *size) == cropped
