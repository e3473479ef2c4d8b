"""The folder ``undistorted`` of cameras without distortion: always PINHOLE, and of its images' sizes."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from snakesfm.errors import ImageError
from snakesfm.export.undistorted import write_undistorted

# the size at which COLMAP, warping what needs no warp, loses two columns and two rows
WIDTH, HEIGHT = 570, 380
SPOT = (430, 110)
SUFFIXES = (".jpg", ".png", ".tif", ".webp")
PERSPECTIVE = {
    "SIMPLE_PINHOLE": [480, 280, 185],
    "PINHOLE": [480, 485, 280, 185],
    "SIMPLE_RADIAL": [480, 280, 185, 0],
    "OPENCV": [480, 485, 280, 185, 0, 0, 0, 0],
    "FULL_OPENCV": [480, 485, 280, 185, *[0] * 8],
    "DIVISION": [480, 485, 280, 185, 0],
}
FISHEYE = {
    "SIMPLE_FISHEYE": [300, 280, 185],
    "FISHEYE": [300, 305, 280, 185],
    "SIMPLE_RADIAL_FISHEYE": [300, 280, 185, 0],
    "OPENCV_FISHEYE": [300, 305, 280, 185, 0, 0, 0, 0],
    "THIN_PRISM_FISHEYE": [300, 305, 280, 185, *[0] * 8],
}
DISTORTED = {
    "SIMPLE_RADIAL": [480, 280, 185, -0.1],
    "OPENCV_FISHEYE": [300, 305, 280, 185, 0.02, 0, 0, 0],
}


def undistort(
    folder: Path, model: str, params: list[float], width: int = WIDTH
) -> tuple[pycolmap.Camera, dict[str, np.ndarray], np.ndarray]:
    """The one camera and the images by suffix without distortion, and the one image before."""
    shown = np.full((HEIGHT, width, 3), 60, np.uint8)
    cv2.circle(shown, SPOT, 15, (200, 210, 190), -1)
    (folder / "images").mkdir()
    (folder / "sparse").mkdir()
    camera = pycolmap.Camera(camera_id=1, model=model, width=WIDTH, height=HEIGHT, params=params)
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    for number, suffix in enumerate(SUFFIXES, start=1):
        options = {"lossless": True} if suffix == ".webp" else {"quality": 97}
        Image.fromarray(shown).save(folder / "images" / f"a{suffix}", **options)
        image = pycolmap.Image(name=f"a{suffix}", camera_id=1, image_id=number)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        (folder / "masks").mkdir(exist_ok=True)
        mask = Image.fromarray(np.uint8(255 * (shown[..., 0] > 100)))
        mask.save(folder / "masks" / f"a{suffix}.png")
    reconstruction.write_binary(str(folder / "sparse"))
    flat = folder / "flat"
    write_undistorted(flat, folder / "sparse", folder / "images", folder / "masks", 2)
    assert sorted(path.name for path in flat.iterdir()) == ["images", "masks", "sparse"]
    written = pycolmap.Reconstruction(str(flat / "sparse" / "0"))
    assert written.num_reg_images() == len(SUFFIXES)
    (camera,) = written.cameras.values()
    images = {}
    for suffix in SUFFIXES:
        images[suffix] = np.asarray(Image.open(flat / "images" / f"a{suffix}"))
        mask = np.asarray(Image.open(flat / "masks" / f"a{suffix}.png"))
        assert images[suffix].shape == (camera.height, camera.width, 3)
        assert mask.shape == (camera.height, camera.width)
        assert set(np.unique(mask)) == {0, 255}
        assert np.mean((mask > 0) != (images[suffix][..., 0] > 130)) < 0.002
    return camera, images, shown


@pytest.mark.parametrize("model", sorted(PERSPECTIVE))
def test_perspective_images_without_distortion_keep_every_pixel(tmp_path, model: str) -> None:
    params = PERSPECTIVE[model]
    camera, images, shown = undistort(tmp_path, model, params)
    assert (camera.model_name, camera.width, camera.height) == ("PINHOLE", WIDTH, HEIGHT)
    single = model.startswith("SIMPLE")
    assert camera.params.tolist() == ([params[0], *params[:3]] if single else params[:4])
    for suffix in (".png", ".tif", ".webp"):
        np.testing.assert_array_equal(images[suffix], shown)
    jpeg = (tmp_path / "images" / "a.jpg").read_bytes()
    assert (tmp_path / "flat" / "images" / "a.jpg").read_bytes() == jpeg


@pytest.mark.parametrize(
    ("model", "params"),
    [*sorted(FISHEYE.items()), *sorted(DISTORTED.items())],
    ids=lambda value: str(value),
)
def test_fisheye_images_are_warped_even_where_all_terms_are_0(
    tmp_path, model: str, params: list[float]
) -> None:
    camera, images, _ = undistort(tmp_path, model, params)
    assert camera.model_name == "PINHOLE"
    before = pycolmap.Camera(camera_id=1, model=model, width=WIDTH, height=HEIGHT, params=params)
    spot = np.array(SPOT) + 0.5
    expected = camera.img_from_cam(np.append(before.cam_from_img(spot), 1.0))
    assert np.linalg.norm(np.asarray(expected) - spot) > 5.0
    for suffix in SUFFIXES:
        rows, columns = np.nonzero(images[suffix][..., 0] > 130)
        found = np.array([columns.mean(), rows.mean()]) + 0.5
        # a circle becomes an egg
        assert np.linalg.norm(found - expected) < 1.5


def test_an_image_of_another_size_than_its_camera_is_named(tmp_path) -> None:
    with pytest.raises(ImageError, match=r"a\.\w+ has 560 x 380 pixels, but its camera 570 x 380: restore"):
        undistort(tmp_path, "SIMPLE_RADIAL", DISTORTED["SIMPLE_RADIAL"], width=560)


@pytest.mark.parametrize(
    "file",
    [
        "images/a.jpg",
        *(f"sparse/{part}.bin" for part in ("cameras", "images", "rigs", "frames", "points3D")),
    ],
)
def test_files_that_colmap_has_no_room_for_are_found(
    tmp_path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    write = pycolmap.undistort_images

    def write_in_vain(target: str, *arguments, **options) -> None:
        write(target, *arguments, **options)
        cut = Path(target) / file
        cut.write_bytes(cut.read_bytes()[:-1])

    monkeypatch.setattr(pycolmap, "undistort_images", write_in_vain)
    with pytest.raises(OSError, match="No space left"):
        undistort(tmp_path, "SIMPLE_RADIAL", DISTORTED["SIMPLE_RADIAL"])


def test_a_mask_that_cannot_be_written_is_no_success(tmp_path) -> None:
    # a folder takes its place
    (tmp_path / "flat" / "masks" / "a.png.png").mkdir(parents=True)
    with pytest.raises(OSError, match="No space left"):
        undistort(tmp_path, "SIMPLE_RADIAL", DISTORTED["SIMPLE_RADIAL"])


def test_what_a_camera_appends_to_a_jpeg_is_copied_with_it(tmp_path, monkeypatch) -> None:
    save = Image.Image.save

    def save_and_append(image: Image.Image, file: Path, *arguments, **options) -> None:
        save(image, file, *arguments, **options)
        if file.suffix == ".jpg":
            file.write_bytes(file.read_bytes() + b"of the maker")

    monkeypatch.setattr(Image.Image, "save", save_and_append)
    undistort(tmp_path, "PINHOLE", PERSPECTIVE["PINHOLE"])
    assert (tmp_path / "flat" / "images" / "a.jpg").read_bytes().endswith(b"of the maker")


@pytest.mark.parametrize("suffix", [".webp", ".png", ".tif", ".jpg"])
def test_what_colmap_cannot_read_is_undistorted_too(tmp_path, suffix: str) -> None:
    images, sparse = tmp_path / "images", tmp_path / "sparse"
    (images / "a").mkdir(parents=True)
    sparse.mkdir()
    shown = np.full((480, 640, 3), 90, np.uint8)
    cv2.circle(shown, (200, 150), 100, (200, 230, 210), -1)
    file = images / "a" / f"1{suffix}"
    if suffix in (".webp", ".jpg"):
        Image.fromarray(shown).save(file, "WEBP", lossless=True)
    else:
        # 12 bits in 16
        cv2.imwrite(str(file), cv2.cvtColor(shown.astype(np.uint16) << 4, cv2.COLOR_RGB2BGR))
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, -0.1]
    )
    model.add_camera_with_trivial_rig(lens)
    model.add_image_with_trivial_frame(
        pycolmap.Image(name=f"a/1{suffix}", camera_id=1, image_id=1), pycolmap.Rigid3d()
    )
    model.write_binary(str(sparse))
    write_undistorted(tmp_path / "flat", sparse, images, None, 1)
    (camera,) = pycolmap.Reconstruction(str(tmp_path / "flat" / "sparse" / "0")).cameras.values()
    found = np.asarray(Image.open(tmp_path / "flat" / "images" / "a" / f"1{suffix}").convert("RGB"))
    assert found.shape == (camera.height, camera.width, 3)
    center = found[camera.height // 2, camera.width // 2]
    tolerance = 4 if suffix == ".jpg" else 0
    circle = np.median(found[found[..., 1] > 160], axis=0)
    np.testing.assert_allclose(circle, (200, 230, 210), atol=tolerance)
    np.testing.assert_allclose(center, shown[240, 320], atol=tolerance)
