import errno
import io
import mmap
import struct

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from snakesfm.errors import ImageError
from snakesfm.ingest.read import read_header, read_image


@pytest.fixture(scope="module")
def picture():
    rng = np.random.default_rng(3)
    noise = gaussian_filter(rng.normal(size=(150, 200, 3)), (2, 2, 0))
    return np.uint8(255 * (noise - noise.min()) / np.ptp(noise))


def save(array_or_image, path, **options):
    image = array_or_image if isinstance(array_or_image, Image.Image) else Image.fromarray(array_or_image)
    image.save(path, **options)
    return path


def orientation(value):
    exif = Image.Exif()
    exif[0x112] = value
    return exif


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.webp"])
def test_lossless_formats_are_exact(tmp_path, picture, name):
    path = save(picture, tmp_path / name, **({"lossless": True} if name == "a.webp" else {}))
    pixels = read_image(path)
    np.testing.assert_array_equal(pixels.rgb, picture)
    np.testing.assert_array_equal(pixels.gray, cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
    assert (read_header(path).width, read_header(path).height) == (200, 150)


def test_jpeg_is_what_pil_and_colmap_decode(tmp_path, picture):
    path = save(picture, tmp_path / "a.JPG", quality=90)
    pixels = read_image(path)
    np.testing.assert_array_equal(pixels.rgb, np.asarray(Image.open(path)))
    colmap = pycolmap.Bitmap.read(path, True).to_array()
    assert np.abs(pixels.rgb.astype(int) - colmap).max() <= 2


def test_a_file_system_that_maps_no_files_is_read(tmp_path, picture, monkeypatch):
    def refuse(*_, **__):
        raise OSError(errno.ENODEV, "No such device")

    path = save(picture, tmp_path / "a.jpg", exif=orientation(6).tobytes())
    expected = read_header(path)
    monkeypatch.setattr(mmap, "mmap", refuse)
    assert read_header(path) == expected
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ImageError, match="truncated"):
        read_header(path)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif"])
@pytest.mark.parametrize("value", range(1, 9))
def test_orientation_is_told_but_not_applied(tmp_path, picture, name, value):
    path = save(picture, tmp_path / name, exif=orientation(value).tobytes())
    header = read_header(path)
    assert header.exif.orientation == value
    assert (header.width, header.height) == (200, 150)
    camera = pycolmap.infer_camera_from_image(path)
    assert (camera.width, camera.height) == (200, 150)
    pixels = read_image(path).rgb
    assert np.abs(pixels - pycolmap.Bitmap.read(path, True).to_array().astype(int)).max() <= 2
    if name != "a.jpg":
        np.testing.assert_array_equal(pixels, picture)


def test_modes_show_the_same_scene(tmp_path, picture):
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    image = Image.fromarray(picture)
    wide = Image.fromarray(gray.astype(np.uint16) * 257)
    paths = {
        "gray.png": save(gray, tmp_path / "gray.png"),
        "gray.jpg": save(gray, tmp_path / "gray.jpg", quality=98),
        "deep.png": save(wide, tmp_path / "deep.png"),
        "deep.tif": save(wide, tmp_path / "deep.tif"),
        "int32.tif": save(Image.fromarray(gray.astype(np.int32)), tmp_path / "int32.tif"),
        "float.tif": save(Image.fromarray(gray.astype(np.float32) / 255), tmp_path / "float.tif"),
        "alpha.png": save(image.convert("RGBA"), tmp_path / "alpha.png"),
        "grayalpha.png": save(Image.fromarray(gray).convert("LA"), tmp_path / "grayalpha.png"),
        "cmyk.jpg": save(image.convert("CMYK"), tmp_path / "cmyk.jpg", quality=98),
        "palette.png": save(image.quantize(256), tmp_path / "palette.png"),
        "ycbcr.tif": save(image.convert("YCbCr"), tmp_path / "ycbcr.tif"),
    }
    for name, path in paths.items():
        pixels = read_image(path)
        assert pixels.gray.dtype == pixels.rgb.dtype == np.uint8
        assert pixels.gray.shape == (150, 200)
        assert pixels.rgb.shape == (150, 200, 3)
        assert np.corrcoef(pixels.gray.ravel(), gray.ravel())[0, 1] > 0.96, name
        assert abs(pixels.gray.mean() - gray.mean()) < 6, name


def test_16_bit_colour_and_12_bit_data(tmp_path, picture):
    path = tmp_path / "deep.png"
    cv2.imwrite(str(path), cv2.cvtColor(picture.astype(np.uint16) * 257, cv2.COLOR_RGB2BGR))
    assert np.abs(read_image(path).rgb.astype(int) - picture).max() <= 1
    gray = picture[..., 0]
    twelve = save(Image.fromarray(gray.astype(np.uint16) << 4), tmp_path / "twelve.tif")
    np.testing.assert_array_equal(read_image(twelve).gray, gray)


@pytest.mark.parametrize("name", ["deep.png", "deep.tif"])
def test_colours_of_12_bits_in_16_are_not_dark(tmp_path, picture, name):
    path = tmp_path / name
    bright = 255 - picture // 2
    cv2.imwrite(str(path), cv2.cvtColor(bright.astype(np.uint16) << 4, cv2.COLOR_RGB2BGR))
    np.testing.assert_array_equal(read_image(path).rgb, bright)


def deep_tiff(path, colours, orientation, extra_samples=()):
    """A TIFF file of one strip of 16-bit colours (H,W,C), which neither PIL nor OpenCV writes turned."""
    height, width, channels = colours.shape
    data = colours.astype("<u2").tobytes()
    short, long = 3, 4
    tags = [
        (256, long, [width]),
        (257, long, [height]),
        (258, short, [16] * channels),
        (259, short, [1]),
        (262, short, [2]),
        (273, long, [8]),
        (274, short, [orientation]),
        (277, short, [channels]),
        (278, long, [height]),
        (279, long, [len(data)]),
        *([(338, short, list(extra_samples))] if extra_samples else []),
    ]
    entries, rest = b"", b""
    place = 8 + len(data) + 2 + 12 * len(tags) + 4
    for tag, kind, values in tags:
        packed = struct.pack(f"<{len(values)}{'H' if kind == short else 'I'}", *values)
        if len(packed) > 4:
            packed, rest = struct.pack("<I", place + len(rest)), rest + packed
        entries += struct.pack("<HHI", tag, kind, len(values)) + packed.ljust(4, b"\0")
    directory = struct.pack("<H", len(tags)) + entries + bytes(4)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(data)) + data + directory + rest)
    return path


@pytest.mark.parametrize("value", range(1, 9))
def test_orientation_of_deep_colours_is_not_applied(tmp_path, picture, value):
    path = deep_tiff(tmp_path / "deep.tif", (255 - picture // 2).astype(np.uint16) << 8, value)
    assert read_header(path).exif.orientation == value
    np.testing.assert_array_equal(read_image(path).rgb, (255 - picture // 2))


@pytest.mark.parametrize("name", ["deep.png", "deep.tif"])
def test_transparent_colours_of_12_bits_in_16_are_composed_over_black_and_not_dark(tmp_path, picture, name):
    bright, alpha = (255 - picture // 2), np.zeros(picture.shape[:2], np.uint16)
    alpha[:, :90], alpha[:, 90:140] = 0xFFFF, 0x7FFF
    colours = np.dstack([bright.astype(np.uint16) << 4, alpha])
    path = tmp_path / name
    if name.endswith(".png"):
        cv2.imwrite(str(path), cv2.cvtColor(colours, cv2.COLOR_RGBA2BGRA))
    else:
        deep_tiff(path, colours, 1, extra_samples=(2,))
    found = read_image(path).rgb
    np.testing.assert_array_equal(found[:, :90], bright[:, :90])
    np.testing.assert_allclose(found[:, 90:140], bright[:, 90:140] / 2, atol=1)
    assert not found[:, 140:].any()


def test_deep_colours_that_alpha_is_multiplied_into_stay_as_they_are(tmp_path, picture):
    colours = np.dstack(
        [(255 - picture // 2).astype(np.uint16) << 4, picture[..., 0].astype(np.uint16) << 8]
    )
    path = deep_tiff(tmp_path / "deep.tif", colours, 1, extra_samples=(1,))
    np.testing.assert_array_equal(read_image(path).rgb, (255 - picture // 2))


def test_one_bit_and_transparent_pixels(tmp_path, picture):
    bits = picture[..., 0] > 127
    path = save(Image.fromarray(bits), tmp_path / "bits.png")
    np.testing.assert_array_equal(read_image(path).gray, np.where(bits, 255, 0))
    alpha = np.dstack([picture, np.where(bits, 255, 0).astype(np.uint8)])
    composed = read_image(save(alpha, tmp_path / "alpha.png")).rgb
    np.testing.assert_array_equal(composed[bits], picture[bits])
    assert not composed[~bits].any()


def test_reduced_decoding_keeps_coordinates(tmp_path):
    # a blob at a known place of an image whose sides are no multiple of the reduction
    height, width, x, y = 801, 1003, 700.5, 333.5
    rows, columns = np.mgrid[:height, :width] + 0.5
    blob = np.uint8(255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 12.0**2)))
    path = save(np.dstack([blob] * 3), tmp_path / "blob.jpg", quality=95)
    assert read_image(path).reduction == read_image(path, 401).reduction == 1
    for side, reduction in ((400, 2), (200, 4), (100, 8), (10, 8)):
        pixels = read_image(path, side)
        assert pixels.reduction == reduction
        assert min(pixels.gray.shape) >= side
        weight = pixels.gray.astype(float) * (pixels.gray > 8)
        rows, columns = (np.mgrid[: pixels.gray.shape[0], : pixels.gray.shape[1]] + 0.5) * reduction
        found = [(weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()]
        np.testing.assert_allclose(found, [x, y], atol=0.1)


def refused(path):
    """The sentence with which both readers refuse a file."""
    with pytest.raises(ImageError) as by_pixels:
        read_image(path)
    with pytest.raises(ImageError) as by_header:
        read_header(path)
    assert str(by_pixels.value) == str(by_header.value)
    assert str(path) in str(by_header.value)
    assert "\n" not in str(by_header.value)
    return str(by_header.value)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
@pytest.mark.parametrize("part", [0.3, 0.6, 0.97])
def test_cut_off_files_are_refused(tmp_path, picture, name, part):
    whole = save(picture, tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: int(part * len(whole))])
    assert "intact copy" in refused(tmp_path / name)


def test_cut_off_jpeg_with_a_complete_thumbnail_is_refused(tmp_path, picture):
    thumbnail = io.BytesIO()
    Image.fromarray(picture[::4, ::4]).save(thumbnail, "JPEG")
    path = save(picture, tmp_path / "a.jpg")
    whole = path.read_bytes()
    segment = b"\xff\xe1" + (len(thumbnail.getvalue()) + 2).to_bytes(2, "big") + thumbnail.getvalue()
    whole = whole[:2] + segment + whole[2:]
    path.write_bytes(whole)
    read_header(path)
    path.write_bytes(whole[: len(whole) * 2 // 3])
    assert "truncated" in refused(path)


def test_bytes_after_the_end_are_harmless(tmp_path, picture):
    for name in ("a.jpg", "a.png"):
        path = save(picture, tmp_path / name)
        before = read_image(path).rgb
        path.write_bytes(path.read_bytes() + b"\0" * 100 + b"movie")
        read_header(path)
        np.testing.assert_array_equal(read_image(path).rgb, before)


def test_what_is_no_image_is_refused(tmp_path, picture):
    (tmp_path / "text.jpg").write_text("dear diary")
    assert "not a JPEG" in refused(tmp_path / "text.jpg")
    (tmp_path / "empty.png").touch()
    assert "is empty" in refused(tmp_path / "empty.png")
    (tmp_path / "folder.jpg").mkdir()
    assert "is a folder" in refused(tmp_path / "folder.jpg")
    (tmp_path / "link.jpg").symlink_to(tmp_path / "nowhere")
    assert "broken link" in refused(tmp_path / "link.jpg")
    save(picture[:20], tmp_path / "small.png")
    assert "200 x 20" in refused(tmp_path / "small.png")
    save(Image.fromarray(picture), tmp_path / "animation.gif")
    (tmp_path / "animation.gif").rename(tmp_path / "animation.jpg")
    assert "not a JPEG" in refused(tmp_path / "animation.jpg")


def test_png_damaged_inside_is_refused_by_its_pixels(tmp_path, picture):
    path = save(picture, tmp_path / "a.png")
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    path.write_bytes(bytes(data))
    read_header(path)
    with pytest.raises(ImageError, match="is damaged"):
        read_image(path)


def test_first_of_several_pictures(tmp_path, picture):
    first, second = Image.fromarray(picture), Image.fromarray(picture[::-1, ::2].copy())
    first.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=[second], quality=98)
    Image.fromarray(picture).save(tmp_path / "a.tif", save_all=True, append_images=[second.copy()])
    assert read_header(tmp_path / "a.jpg").width == 200
    assert np.abs(read_image(tmp_path / "a.jpg").rgb.astype(int) - picture).mean() < 6
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif").rgb, picture)


def test_other_content_than_the_suffix_says(tmp_path, picture):
    path = save(picture, tmp_path / "a.png")
    path = path.rename(tmp_path / "a.jpg")
    np.testing.assert_array_equal(read_image(path).rgb, picture)


def textured(seed=0):
    """Gray values (300,400) of 0 to 1 with detail at all scales."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.random((3 * k, 4 * k)), (400, 300)) for k in (2, 10, 50)]
    values = sum(layers)
    return (values - values.min()) / np.ptp(values)


def spoilt(values, pixels, value):
    values = values.copy()
    values.ravel()[:pixels] = value
    return values


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("hot.png", spoilt((textured() * 4095).astype(np.uint16), 1, 65535)),
        ("thermal.tif", (29000 + textured() * 2040).astype(np.uint16)),
        ("unit.tif", textured().astype(np.float32)),
        ("hot.tif", spoilt(textured().astype(np.float32), 1, 50.0)),
        ("nodata.tif", spoilt(textured().astype(np.float32), 1200, -9999.0)),
        ("nan.tif", spoilt(textured().astype(np.float32), 1200, np.nan)),
    ],
)
def test_numbers_of_narrow_range_or_beside_a_stray_one_keep_their_detail(tmp_path, name, values):
    cv2.imwrite(str(tmp_path / name), values)
    gray = read_image(tmp_path / name).gray
    inside = gray.ravel()[1200:]
    expected = np.round(textured().ravel()[1200:] * 255)
    assert len(np.unique(inside)) > 200
    assert np.corrcoef(inside, expected)[0, 1] > 0.99
    assert np.abs(np.median(inside) - np.median(expected)) < 25


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_numbers_that_use_their_bits_are_shifted_as_before(tmp_path, bits):
    values = (textured() * (2**bits - 1)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), values)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png").gray, values >> (bits - 8))
