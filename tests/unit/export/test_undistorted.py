"""The pictures of the folder ``undistorted``: PINHOLE, with the principal point in the middle."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image, JpegImagePlugin

from snakesfm.errors import ImageError
from snakesfm.export.undistorted import FlatCamera, flatten, write_undistorted
from snakesfm.geometry.camera import Camera

# the size at which COLMAP, warping what needs no warp, loses two columns and two rows
WIDTH, HEIGHT = 570, 380
SPOT = (430, 110)
SUFFIXES = (".jpg", ".png", ".tif", ".webp")
MIDDLE, OFF = (285.4, 189.6), (300.3, 185.0)
# by their principal point
PERSPECTIVE = {
    "SIMPLE_PINHOLE": lambda *center: (480, *center),
    "PINHOLE": lambda *center: (480, 485, *center),
    "SIMPLE_RADIAL": lambda *center: (480, *center, 0),
    "OPENCV": lambda *center: (480, 485, *center, 0, 0, 0, 0),
    "FULL_OPENCV": lambda *center: (480, 485, *center, *[0] * 8),
    "DIVISION": lambda *center: (480, 485, *center, 0),
}
FISHEYE = {
    "SIMPLE_FISHEYE": (300, 280, 185),
    "FISHEYE": (300, 305, 280, 185),
    "SIMPLE_RADIAL_FISHEYE": (300, 280, 185, 0),
    "OPENCV_FISHEYE": (300, 305, 280, 185, 0, 0, 0, 0),
    "THIN_PRISM_FISHEYE": (300, 305, 280, 185, *[0] * 8),
}
DISTORTED = {
    "SIMPLE_RADIAL": (480, 280, 185, -0.1),
    "OPENCV_FISHEYE": (300, 305, 280, 185, 0.02, 0, 0, 0),
}


def undistort(
    folder: Path, model: str, params: tuple[float, ...], width: int = WIDTH
) -> tuple[FlatCamera, dict[str, np.ndarray], np.ndarray]:
    """The camera and the images by suffix without distortion, and the one image before."""
    shown = np.full((HEIGHT, width, 3), 60, np.uint8)
    cv2.circle(shown, SPOT, 15, (200, 210, 190), -1)
    for part in ("images", "masks"):
        (folder / part).mkdir()
    for suffix in SUFFIXES:
        options = {"lossless": True} if suffix == ".webp" else {"quality": 97}
        Image.fromarray(shown).save(folder / "images" / f"a{suffix}", **options)
        mask = Image.fromarray(np.uint8(255 * (shown[..., 0] > 100)))
        mask.save(folder / "masks" / f"a{suffix}.png")
    flat = flatten(Camera(model, WIDTH, HEIGHT, params))
    target, names = folder / "flat", [f"a{suffix}" for suffix in SUFFIXES]
    write_undistorted(target, folder / "images", folder / "masks", dict.fromkeys(names, flat), 2)
    assert sorted(path.name for path in target.iterdir()) == ["images", "masks"]
    camera = flat.camera
    assert camera.model == "PINHOLE"
    off = np.abs(np.array(camera.params[2:]) - (camera.width / 2, camera.height / 2))
    assert (off <= 0.5).all()
    images = {}
    for suffix in SUFFIXES:
        images[suffix] = np.asarray(Image.open(target / "images" / f"a{suffix}"))
        mask = np.asarray(Image.open(target / "masks" / f"a{suffix}.png"))
        assert images[suffix].shape == (camera.height, camera.width, 3)
        assert mask.shape == (camera.height, camera.width)
        assert set(np.unique(mask)) == {0, 255}
        assert np.mean((mask > 0) != (images[suffix][..., 0] > 130)) < 0.002
    return flat, images, shown


@pytest.mark.parametrize("model", sorted(PERSPECTIVE))
def test_images_without_distortion_keep_every_pixel_about_the_middle(tmp_path, model: str) -> None:
    params = PERSPECTIVE[model](*MIDDLE)
    flat, images, shown = undistort(tmp_path, model, params)
    single = model.startswith("SIMPLE")
    assert flat.camera.params == ((params[0], *params[:3]) if single else params[:4])
    assert (flat.camera.width, flat.camera.height) == (WIDTH, HEIGHT)
    assert (flat.cropped, flat.shown) == (0.0, 1.0)
    for suffix in (".png", ".tif", ".webp"):
        np.testing.assert_array_equal(images[suffix], shown)
    jpeg = (tmp_path / "images" / "a.jpg").read_bytes()
    assert (tmp_path / "flat" / "images" / "a.jpg").read_bytes() == jpeg


@pytest.mark.parametrize("model", sorted(PERSPECTIVE))
def test_images_are_cropped_where_the_principal_point_is_off_the_middle(tmp_path, model: str) -> None:
    flat, images, shown = undistort(tmp_path, model, PERSPECTIVE[model](*OFF))
    # 2 x (570 - 300.3) columns at the right, 2 x 185 rows at the top
    assert (flat.left, flat.top) == (31, 0)
    assert (flat.camera.width, flat.camera.height) == (539, 370)
    assert flat.camera.params[2:] == pytest.approx((269.3, 185.0))
    assert flat.cropped == pytest.approx(1 - 539 * 370 / (WIDTH * HEIGHT))
    for suffix, difference in ((".png", 0), (".tif", 0), (".webp", 0), (".jpg", 20)):
        np.testing.assert_allclose(images[suffix], shown[:370, 31:], atol=difference)


@pytest.mark.parametrize(("center", "left", "width"), [(-3.0, 0, 1), (572.0, 569, 1), (0.2, 0, 1)])
def test_next_to_nothing_is_left_of_a_picture_that_its_camera_looks_past(center, left, width) -> None:
    flat = flatten(Camera("PINHOLE", WIDTH, HEIGHT, (480, 485, center, 190)))
    assert (flat.left, flat.camera.width) == (left, width)
    assert flat.cropped > 0.99


@pytest.mark.parametrize(
    ("model", "params"),
    [*sorted(FISHEYE.items()), *sorted(DISTORTED.items())],
    ids=lambda value: str(value),
)
def test_fisheye_images_are_warped_even_where_all_terms_are_0(
    tmp_path, model: str, params: tuple[float, ...]
) -> None:
    flat, images, _ = undistort(tmp_path, model, params)
    spot = np.array(SPOT) + 0.5
    (expected,) = flat.move(spot[None])
    rays = Camera(model, WIDTH, HEIGHT, params).normalize(spot[None])
    projected = flat.camera.to_pycolmap().img_from_cam(np.append(rays[0], 1.0))
    np.testing.assert_allclose(expected, projected, atol=1e-3)
    assert np.linalg.norm(expected - spot) > 5.0
    for suffix in SUFFIXES:
        rows, columns = np.nonzero(images[suffix][..., 0] > 130)
        found = np.array([columns.mean(), rows.mean()]) + 0.5
        # a circle becomes an egg
        assert np.linalg.norm(found - expected) < 1.5


def test_an_image_of_another_size_than_its_camera_is_named(tmp_path) -> None:
    with pytest.raises(ImageError, match=r"a\.\w+ has 560 x 380 pixels, but its camera 570 x 380: restore"):
        undistort(tmp_path, "SIMPLE_RADIAL", DISTORTED["SIMPLE_RADIAL"], width=560)


@pytest.mark.parametrize(
    "params", [DISTORTED["SIMPLE_RADIAL"], (480, *MIDDLE, 0)], ids=["warped", "copied"]
)
@pytest.mark.parametrize("file", ["images/a.jpg", "images/a.png", "masks/a.tif.png"])
def test_a_full_disk_is_no_success(tmp_path, file: str, params: tuple[float, ...]) -> None:
    (tmp_path / "flat" / file).parent.mkdir(parents=True)
    (tmp_path / "flat" / file).symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        undistort(tmp_path, "SIMPLE_RADIAL", params)


def test_what_a_camera_appends_to_a_jpeg_is_copied_with_it(tmp_path, monkeypatch) -> None:
    save = Image.Image.save

    def save_and_append(image: Image.Image, file: Path, *arguments, **options) -> None:
        save(image, file, *arguments, **options)
        if isinstance(file, Path) and file.suffix == ".jpg":
            file.write_bytes(file.read_bytes() + b"of the maker")

    monkeypatch.setattr(Image.Image, "save", save_and_append)
    undistort(tmp_path, "PINHOLE", PERSPECTIVE["PINHOLE"](*MIDDLE))
    assert (tmp_path / "flat" / "images" / "a.jpg").read_bytes().endswith(b"of the maker")


@pytest.mark.parametrize("sampling", [0, 2])
@pytest.mark.parametrize("long", [False, True])
def test_a_jpeg_keeps_its_exif_its_colours_and_all_detail(tmp_path, sampling: int, long: bool) -> None:
    exif = Image.Exif()
    exif[271] = "maker"
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    file = tmp_path / "a.JPG"
    Image.fromarray(noise).save(
        file, "JPEG", exif=exif, icc_profile=b"profile", subsampling=sampling, quality=50
    )
    if long:
        # what PIL reads as one
        segment = b"\xff\xe1\xea\x60Exif\0\0" + bytes(0xEA60 - 8)
        content = file.read_bytes()
        file.write_bytes(content[:2] + segment + segment + content[2:])
    flat = flatten(Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, DISTORTED["SIMPLE_RADIAL"]))
    write_undistorted(tmp_path / "flat", tmp_path, None, {"a.JPG": flat}, 1)
    with Image.open(tmp_path / "flat" / "images" / "a.JPG") as image:
        assert image.info["icc_profile"] == b"profile"
        assert image.getexif().get(271) == (None if long else "maker")
        assert JpegImagePlugin.get_sampling(image) == sampling
        assert all(max(table) == 1 for table in image.quantization.values())


@pytest.mark.parametrize("suffix", [".webp", ".png", ".tif", ".jpg"])
def test_what_colmap_cannot_read_is_undistorted_too(tmp_path, suffix: str) -> None:
    images = tmp_path / "images"
    (images / "a").mkdir(parents=True)
    shown = np.full((480, 640, 3), 90, np.uint8)
    cv2.circle(shown, (200, 150), 100, (200, 230, 210), -1)
    file = images / "a" / f"1{suffix}"
    if suffix in (".webp", ".jpg"):
        Image.fromarray(shown).save(file, "WEBP", lossless=True)
    else:
        # 12 bits in 16
        cv2.imwrite(str(file), cv2.cvtColor(shown.astype(np.uint16) << 4, cv2.COLOR_RGB2BGR))
    flat = flatten(Camera("SIMPLE_RADIAL", 640, 480, (500, 320, 240, -0.1)))
    write_undistorted(tmp_path / "flat", images, None, {f"a/1{suffix}": flat}, 1)
    found = np.asarray(Image.open(tmp_path / "flat" / "images" / "a" / f"1{suffix}").convert("RGB"))
    assert found.shape == (flat.camera.height, flat.camera.width, 3)
    center = found[found.shape[0] // 2, found.shape[1] // 2]
    tolerance = 4 if suffix == ".jpg" else 0
    circle = np.median(found[found[..., 1] > 160], axis=0)
    np.testing.assert_allclose(circle, (200, 230, 210), atol=tolerance)
    np.testing.assert_allclose(center, shown[240, 320], atol=tolerance)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_colmap_makes_the_same_picture_but_for_the_crop(tmp_path, model: str) -> None:
    lens = Camera(model, WIDTH, HEIGHT, DISTORTED[model])
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    bitmap, whole = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(), pycolmap.Bitmap.from_array(pixels), lens.to_pycolmap()
    )
    flat = flatten(lens)
    assert flat.cropped > 0.01
    rows, columns = slice(flat.top, flat.top + flat.camera.height), slice(flat.left, None)
    expected = bitmap.to_array()[rows, columns][:, : flat.camera.width]
    np.testing.assert_array_equal(flat.show(pixels), expected)
    moved = np.array(whole.params[2:]) - (flat.left, flat.top)
    np.testing.assert_allclose(flat.camera.params, (*whole.params[:2], *moved))
