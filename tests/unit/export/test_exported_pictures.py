"""The images and masks beside an exported model, as they are and without distortion."""

import dataclasses
import json
from pathlib import Path

import cv2
import finished_model
import numpy as np
import pycolmap
import pytest
from finished_model import CAMERA, COUNT, FILES, LOST, NAMES, export, make_images
from PIL import Image

from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem

ORIENTATION = 0x0112


def test_images_are_one_relative_link_and_a_second_run_gives_the_same_bytes(tmp_path, problem) -> None:
    folder = export(tmp_path, problem)
    link = folder / "images"
    assert link.is_symlink()
    assert not link.readlink().is_absolute()
    before = {file: (folder / file).read_bytes() for file in FILES}
    export(tmp_path, problem)
    assert before == {file: (folder / file).read_bytes() for file in FILES}
    assert (link / NAMES[0]).is_file()
    tmp_path.rename(tmp_path.with_name("moved"))
    assert (tmp_path.with_name("moved") / "out/scene/export_model/images" / NAMES[0]).is_file()
    tmp_path.with_name("moved").rename(tmp_path)


def test_images_are_copied_where_links_cannot_be_made(tmp_path, problem, monkeypatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    folder = export(tmp_path, problem)
    assert not (folder / "images").is_symlink()
    assert (folder / "images" / NAMES[1]).read_bytes() == (tmp_path / "photos" / NAMES[1]).read_bytes()


def test_an_image_that_exif_turns_is_shown_as_it_is_stored(tmp_path, problem) -> None:
    photos = make_images(tmp_path / "photos")
    stored = np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(stored).save(photos / NAMES[2], exif=exif)
    orientations = np.ones(COUNT, np.int32)
    orientations[2] = 6
    folder = export(tmp_path, problem, orientations)
    shown = folder / "images" / NAMES[2]
    # OpenCV turns images by their EXIF, PIL does not
    assert cv2.imread(str(photos / NAMES[2])).shape[:2] == (64, 48)
    assert cv2.imread(str(shown)).shape[:2] == (48, 64)
    with Image.open(shown) as image, Image.open(photos / NAMES[2]) as original:
        assert image.getexif()[ORIENTATION] == 1
        np.testing.assert_array_equal(np.asarray(image), np.asarray(original))
    assert (folder / "images" / NAMES[1]).is_symlink()
    export(tmp_path, problem)
    assert (folder / "images").is_symlink()


def test_masks_go_with_the_images_where_all_have_one_of_their_size(tmp_path, problem) -> None:
    masks = tmp_path / "masks"
    for name in NAMES:
        (masks / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (640, 480), 255).save(masks / f"{name}.png")
    folder = export(tmp_path, problem, masks=masks)
    frames = json.loads((folder / "transforms.json").read_text("utf-8"))["frames"]
    assert [frame["mask_path"] for frame in frames] == [f"masks/{name}.png" for name in NAMES[:LOST]]
    assert all((folder / frame["mask_path"]).is_file() for frame in frames)
    Image.new("L", (320, 240), 255).save(masks / f"{NAMES[3]}.png")
    export(tmp_path, problem, masks=masks)
    content = json.loads((folder / "transforms.json").read_text("utf-8"))
    assert not any("mask_path" in frame for frame in content["frames"])
    assert not (folder / "masks").exists()
    *_, warning = json.loads((folder / "summary.json").read_text("utf-8"))["warnings"]
    assert f"1 images have no mask of their own size, e.g. '{NAMES[3]}'" in warning


@pytest.mark.parametrize("kind", ["RGB", "RGBA", "P", "1", "I;16"])
def test_masks_that_nerfstudio_misreads_are_copied_as_0_and_255(tmp_path, problem, kind: str) -> None:
    masks = tmp_path / "masks"
    shown = np.zeros((480, 640), np.uint8)
    shown[:100] = 1
    if kind == "P":
        mask = Image.fromarray(1 - shown)
        mask.putpalette([9, 9, 9, 0, 0, 0])
    elif kind == "I;16":
        mask = Image.fromarray(shown.astype(np.uint16))
    else:
        mask = Image.fromarray(255 * shown).convert(kind)
    for name in NAMES:
        (masks / name).parent.mkdir(parents=True, exist_ok=True)
        mask.save(masks / f"{name}.png")
    folder = export(tmp_path, problem, masks=masks)
    for frame in json.loads((folder / "transforms.json").read_text("utf-8"))["frames"]:
        with Image.open(folder / frame["mask_path"]) as copied:
            assert copied.mode == "L"
            np.testing.assert_array_equal(np.asarray(copied), 255 * shown)
    for name in NAMES:
        Image.fromarray(255 * shown).save(masks / f"{name}.png")
    assert (export(tmp_path, problem, masks=masks) / "masks").is_symlink()


def test_undistorted_images_have_pinhole_cameras_and_go_when_no_longer_asked_for(tmp_path, problem) -> None:
    photos = tmp_path / "photos"
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (640, 480), "red").save(photos / name)
    folder = export(tmp_path, problem, undistort=True)
    sparse = folder / "undistorted" / "sparse" / "0"
    model = pycolmap.Reconstruction(str(sparse))
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_reg_images() == COUNT - 1
    assert model.num_points3D() == len(problem.points)
    assert len(list((folder / "undistorted" / "images").rglob("*.jpg"))) == COUNT - 1
    # Inria's 3DGS reads it where names are not ASCII
    text = [line.split() for line in (sparse / "cameras.txt").read_text().splitlines() if line[0] != "#"]
    assert [line[1] for line in text] == ["PINHOLE", "PINHOLE"]
    assert NAMES[0].encode() in (sparse / "images.txt").read_bytes()
    assert not (folder / "undistorted" / "masks").exists()
    export(tmp_path, problem)
    assert not (folder / "undistorted").exists()


@pytest.mark.parametrize(
    ("lens", "told"),
    [
        (dataclasses.replace(CAMERA, params=(500.0, 300.0, 250.0, -0.1)), True),
        (dataclasses.replace(CAMERA, params=(500.0, 335.0, 236.0, 0.0)), True),
        (dataclasses.replace(CAMERA, params=(500.0, 322.0, 239.0, 0.05)), False),
        (Camera("OPENCV_FISHEYE", 640, 480, (400.0, 400.0, 322.0, 239.0, 0.01, 0.0, 0.0, 0.0)), False),
    ],
    ids=["off, distorted", "off", "distorted", "fisheye"],
)
@pytest.mark.parametrize("all_keypoints", [False, True])
def test_the_undistorted_model_is_of_the_pictures_about_their_principal_points(
    tmp_path, monkeypatch, lens: Camera, told: bool, all_keypoints: bool
) -> None:
    monkeypatch.setattr(finished_model, "CAMERA", lens)
    seen = make_problem(camera_count=COUNT, point_count=300, noise_px=0.3, camera=lens)
    photos = tmp_path / "photos"
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (640, 480), "red").save(photos / name)
    folder = export(tmp_path, seen, undistort=True, all_keypoints=all_keypoints)
    original = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    model = pycolmap.Reconstruction(str(folder / "undistorted" / "sparse" / "0"))
    for camera in model.cameras.values():
        middle = np.array([camera.width, camera.height]) / 2
        assert (np.abs(np.array(camera.params[2:]) - middle) <= 0.5).all()
    for key, image in model.images.items():
        assert image.num_points2D() == original.images[key].num_points2D() > 0
        with Image.open(folder / "undistorted" / "images" / image.name) as picture:
            assert picture.size == (image.camera.width, image.camera.height)
    model.update_point_3d_errors()
    assert 0.2 < model.compute_mean_reprojection_error() < 0.6
    warnings = json.loads((folder / "summary.json").read_text("utf-8"))["warnings"]
    found = [line for line in warnings if "the pixels were cut off in undistorted/" in line]
    assert len(found) == 2 * told


def test_masks_are_undistorted_as_their_images_are(
    tmp_path, problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = dataclasses.replace(CAMERA, params=(*CAMERA.params[:3], 0.3))
    monkeypatch.setattr(finished_model, "CAMERA", lens)
    photos, masks = tmp_path / "photos", tmp_path / "masks"
    height, width = 480, 640
    shown = np.zeros((height, width), np.uint8)
    cv2.circle(shown, (200, 150), 120, 255, -1)
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.repeat(shown[..., None], 3, axis=2)).save(photos / name, quality=95)
    (masks / NAMES[0]).parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(masks / f"{NAMES[0]}.png"), shown)
    # of another size, and named in the other way
    small = cv2.resize(shown, (width // 2, height // 2), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str((masks / NAMES[1]).with_suffix(".png")), small)
    folder = export(tmp_path, problem, masks=masks, undistort=True) / "undistorted"
    found = sorted(path.relative_to(folder / "masks").as_posix() for path in folder.rglob("*.png"))
    assert found == sorted(f"{name}.png" for name in NAMES[:2])
    for name, most in ((NAMES[0], 0.002), (NAMES[1], 0.01)):
        image = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE)
        mask = cv2.imread(str(folder / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == image.shape
        assert set(np.unique(mask)) == {0, 255}
        assert np.mean((image > 127) != (mask > 0)) < most
    # the lens moves the circle's edge
    assert np.mean((cv2.resize(shown, image.shape[::-1]) > 127) != (image > 127)) > 0.02
