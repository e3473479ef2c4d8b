"""export_model on small artifacts with exact truth: COLMAP's files, transforms.json, images and warnings."""

import dataclasses
import json
import resource
import struct
from pathlib import Path
from types import SimpleNamespace

import cv2
import finished_model
import numpy as np
import pycolmap
import pytest
from finished_model import CAMERA, COUNT, FILES, LOST, NAMES, OVERLAY, export, make_images
from PIL import Image

from snakesfm.artifacts import Reconstruction
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.geometry.camera import Camera
from snakesfm.stages import export_model
from snakesfm.synthetic.problems import make_problem

ORIENTATION = 0x0112


def test_colmap_reads_what_was_reconstructed_from_binary_and_text(tmp_path, problem) -> None:
    folder = export(tmp_path, problem)
    assert all((folder / file).stat().st_size > 0 for file in FILES)
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    text_only = tmp_path / "text"
    text_only.mkdir()
    for part in ("cameras", "images", "points3D"):
        (text_only / f"{part}.txt").write_bytes((folder / "sparse/0" / f"{part}.txt").read_bytes())
    for place in (folder / "sparse" / "0", text_only):
        model = read_model(place)
        assert sorted(model.reg_image_ids()) == [k + 1 for k in range(COUNT) if k != LOST]
        for k, image in ((image_id - 1, image) for image_id, image in model.images.items()):
            assert image.name == NAMES[k]
            assert image.camera_id == k % 2 + 1
            assert np.allclose(image.cam_from_world().rotation.matrix(), problem.rotations[k])
            assert np.allclose(image.cam_from_world().translation, problem.translations[k])
        assert np.allclose(model.points3D[3].xyz, problem.points[2])
        assert model.points3D[3].color.tolist() == [6, 7, 8]
        assert model.points3D[1].error == pytest.approx(0.1)
        assert model.num_points3D() == len(problem.points)
        element = model.points3D[5].track.elements[0]
        observed = model.images[element.image_id].points2D[element.point2D_idx]
        assert observed.point3D_id == 5
        row = np.flatnonzero(problem.track_image_ids[slice(*problem.track_offsets[4:6])] != LOST)[0]
        expected = problem.track_keypoints[problem.track_offsets[4] + row]
        assert observed.xy == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("largest", [False, True])
def test_a_model_that_does_not_fit_on_the_disk_is_not_published(tmp_path, problem, largest: bool) -> None:
    """A limit on the size of a file ends a write as a full disk does."""
    folder = export(tmp_path / "whole", problem)
    sizes = sorted(path.stat().st_size for path in (folder / "sparse" / "0").iterdir())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # the inputs are written before the limit is set
    make_images(tmp_path / "photos")
    write = export_model._write_colmap

    def write_limited(*arguments) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (sizes[-1] - 1 if largest else sizes[0], hard))
        try:
            write(*arguments)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export_model, "_write_colmap", write_limited)
        with pytest.raises(OSError, match="No space left"):
            export(tmp_path, problem)
    assert [path.name for path in (tmp_path / "out" / "scene" / "export_model").iterdir()] == []


def test_all_keypoints_are_numbered_as_the_features_are(tmp_path, problem) -> None:
    model = read_model(export(tmp_path, problem, all_keypoints=True) / "sparse" / "0")
    some = read_model(export(tmp_path / "some", problem) / "sparse" / "0")
    for image_id, image in model.images.items():
        keypoints = problem.keypoints[image_id - 1]
        pixels = np.array([point.xy for point in image.points2D])
        np.testing.assert_allclose(pixels, np.vstack([keypoints, [[7, 9]]]), atol=1e-4)
        assert [point.has_point3D() for point in image.points2D] == [True] * len(keypoints) + [False]
        assert some.images[image_id].num_points2D() == len(keypoints)
    for point_id, point in model.points3D.items():
        assert np.allclose(point.xyz, some.points3D[point_id].xyz)
        rows = slice(*problem.track_offsets[point_id - 1 : point_id + 1])
        there = zip(problem.track_image_ids[rows] + 1, problem.track_keypoint_ids[rows], strict=True)
        found = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        assert found == [(i, k) for i, k in there if i != LOST + 1]


def test_reprojection_in_the_exported_model_is_that_of_the_noise(tmp_path, problem) -> None:
    pinhole = make_problem(camera_count=COUNT, point_count=300, noise_px=0.3, camera=CAMERA)
    model = pycolmap.Reconstruction(str(export(tmp_path, pinhole) / "sparse" / "0"))
    model.update_point_3d_errors()
    assert 0.2 < model.compute_mean_reprojection_error() < 0.6


def test_transforms_have_opengl_axes_in_the_world_of_the_points(tmp_path, problem) -> None:
    folder = export(tmp_path, problem)
    content = json.loads((folder / "transforms.json").read_text("utf-8"))
    assert content["camera_model"] == "OPENCV"
    assert content["applied_transform"] == np.eye(4)[:3].tolist()
    assert (folder / content["ply_file_path"]).is_file()
    assert len(content["frames"]) == COUNT - 1
    for frame in content["frames"]:
        k = frame["colmap_im_id"] - 1
        assert (folder / frame["file_path"]).is_file()
        pose = np.array(frame["transform_matrix"])
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        local = np.linalg.inv(pose) @ np.append(problem.points[0], 1.0)
        expected = problem.rotations[k] @ problem.points[0] + problem.translations[k]
        assert local[:3] == pytest.approx(expected * [1, -1, -1])
        assert (frame["fl_x"], frame["cx"], frame["k1"], frame["k2"]) == (500.0, 320.0, 0.02, 0.0)


def test_points_are_in_the_ply_with_their_colours(tmp_path, problem) -> None:
    data = (export(tmp_path, problem) / "points.ply").read_bytes()
    head, body = data.split(b"end_header\n")
    assert f"element vertex {len(problem.points)}".encode() in head
    rows = np.frombuffer(body, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    order = np.lexsort(problem.points.T)
    found = np.lexsort(rows["xyz"].T.astype(np.float64))
    assert np.allclose(rows["xyz"][found], problem.points[order], atol=1e-4)
    colors = Reconstruction.read(tmp_path / "reconstruction.h5").colors
    np.testing.assert_array_equal(rows["rgb"][found], colors[order])


def test_summary_says_what_is_there_and_what_is_missing(tmp_path, problem) -> None:
    summary = json.loads((export(tmp_path, problem) / "summary.json").read_text("utf-8"))
    assert (summary["images"], summary["registered_images"]) == (COUNT, COUNT - 1)
    assert summary["not_registered"] == [NAMES[LOST]]
    assert summary["points"] == len(problem.points)
    model = Reconstruction.read(tmp_path / "reconstruction.h5")
    mean_px = np.average(model.errors_px, weights=np.diff(model.offsets))
    assert abs(mean_px - model.errors_px.mean()) > 1e-4
    assert summary["mean_reprojection_error_px"] == pytest.approx(mean_px)
    assert summary["mean_track_length"] == pytest.approx(summary["observations"] / summary["points"])
    spaces, refused, doubted, overlay = summary["warnings"]
    assert (doubted, overlay) == ("5 images have a camera each.", OVERLAY)
    assert "spaces" in spaces
    assert refused == "1 image files could not be used (all in the report): It is a text file."


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


@pytest.mark.parametrize(
    ("distortion", "intrinsics", "remedy"),
    [
        (0.02, "fixed", None),
        (0.3, "fixed", "the given intrinsics do not describe the lens; intrinsics=refine"),
        (0.3, "refine", "this model does not describe the lens; try another index_images.camera_model"),
    ],
)
def test_a_lens_of_another_distortion_is_warned_of(
    tmp_path, distortion: float, intrinsics: str, remedy: str | None
) -> None:
    lens = dataclasses.replace(CAMERA, params=(*CAMERA.params[:3], distortion))
    seen = make_problem(camera_count=COUNT, point_count=3000, noise_px=0.1, camera=lens)
    folder = export(tmp_path, seen, lost=(), intrinsics=intrinsics)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    # the second camera has but four images
    found = [line for line in summary["warnings"] if "describe the lens" in line]
    assert len(found) == (remedy is not None)
    assert all(line.startswith("camera 1 (SIMPLE_RADIAL)") and str(remedy) in line for line in found)


@pytest.mark.parametrize(("reset", "told"), [("", 0), ("distortion", 1)])
def test_a_camera_that_was_reset_and_held_is_warned_of(tmp_path, problem, reset: str, told: int) -> None:
    folder = export(tmp_path, problem, reset=reset)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "reset and kept fixed" in line]
    assert len(found) == told
    assert all(line.startswith("camera 2 (SIMPLE_RADIAL): its distortion was") for line in found)


@pytest.mark.parametrize(("spread", "told"), [(np.nan, 0), (0.083, 1)])
def test_images_of_several_focal_lengths_are_warned_of(tmp_path, problem, spread: float, told: int) -> None:
    summary = json.loads((export(tmp_path, problem, spread=spread) / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "differ in focal length by 8%" in line]
    assert len(found) == told
    assert all("camera 2 (" in line and "{camera_sharing: per_folder}" in line for line in found)


@pytest.mark.parametrize(("offset", "told"), [(np.nan, 0), (0.0614, 1)])
def test_a_far_principal_point_that_was_left_is_warned_of(
    tmp_path, problem, offset: float, told: int
) -> None:
    folder = export(tmp_path, problem, offset=offset)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "max_principal_point_offset" in line]
    assert len(found) == told
    assert all(line.startswith("camera 2 (SIMPLE_RADIAL): its principal point") for line in found)
    assert all("lie 6.1% of the longer side away" in line for line in found)


def test_a_camera_that_got_a_second_focal_length_is_warned_of() -> None:
    stretched = Camera("OPENCV", 640, 480, (600.0, 450.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    former = ["SIMPLE_RADIAL", "SIMPLE_RADIAL", "OPENCV"]
    found = export_model._stretched_warnings({0: CAMERA, 1: stretched, 2: stretched}, former)
    # what was given or chosen is known
    assert [line.split(" (fx")[0] for line in found] == ["camera 2 (OPENCV): its pixels are not square"]
    assert "fx / fy = 1.33" in found[0]


@pytest.mark.parametrize(
    ("lens", "told"),
    [(CAMERA, 0), (dataclasses.replace(CAMERA, model="FOV", params=(250.0, 250.0, 320.0, 240.0, 1.4)), 2)],
    ids=["usual", "beyond 180 degrees"],
)
def test_pictures_of_which_little_is_left_without_distortion_are_warned_of(
    tmp_path, monkeypatch, lens: Camera, told: int
) -> None:
    monkeypatch.setattr(finished_model, "CAMERA", lens)
    usual = Camera("PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0))
    seen = make_problem(camera_count=COUNT, point_count=300, noise_px=0.3, camera=usual)
    photos = tmp_path / "photos"
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (640, 480), "red").save(photos / name)
    for undistort, count in ((False, 0), (True, told)):
        summary = json.loads(
            (export(tmp_path, seen, undistort=undistort) / "summary.json").read_text("utf-8")
        )
        found = [line for line in summary["warnings"] if "undistorted/ shows only" in line]
        assert len(found) == count
        assert all(line.startswith(f"camera {row} (FOV)") for row, line in enumerate(found, start=1))


@pytest.mark.parametrize(("count", "named"), [(6, 6), (60, 5)])
def test_a_problem_of_many_cameras_is_told_of_some(monkeypatch, count: int, named: int) -> None:
    folding = Camera("SIMPLE_RADIAL", 640, 480, (300.0, 320.0, 240.0, -1.2))
    wide = Camera("FOV", 640, 480, (250.0, 250.0, 320.0, 240.0, 1.4))
    adjusted = SimpleNamespace(
        camera_resets=["distortion"] * count,
        camera_offsets=np.full(count, 0.07),
        camera_spreads=np.full(count, 0.1),
    )
    one = SimpleNamespace(
        image_ids=np.zeros(1, int),
        points=np.ones((1, 3)),
        offsets=np.array([0, 1]),
        rotations=np.eye(3)[None],
        translations=np.zeros((1, 3)),
        keypoints=np.zeros((1, 2)),
    )
    misfits = dict.fromkeys(range(count), SimpleNamespace(misfit=np.inf))
    monkeypatch.setattr(export_model, "fit_lenses", lambda *_: misfits)
    monkeypatch.setattr(export_model, "undistorted_share", lambda _: 0.1)
    told = {
        (
            "not invertible",
            "reset and kept fixed",
            "max_principal_point_offset",
            "differ in focal length",
        ): (export_model._camera_warnings(adjusted, dict.fromkeys(range(count), folding))),
        ("does not describe the lens",): export_model._lens_warnings(
            one, [folding] * count, np.zeros(1, int), ()
        ),
        ("undistorted/ shows only",): export_model._cut_warnings(dict.fromkeys(range(count), wide)),
    }
    for kinds, warnings in told.items():
        for kind in kinds:
            found = [line for line in warnings if kind in line]
            assert [line.split()[1] for line in found] == [str(k + 1) for k in range(named)]
        more = [line for line in warnings if "more cameras have the problem" in line]
        assert more == ["55 more cameras have the problem of the warning before this one."] * (
            len(kinds) if count > named else 0
        )
        assert len(warnings) == len(kinds) * named + len(more)


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


def test_undistorted_images_have_pinhole_cameras_and_go_when_no_longer_asked_for(tmp_path, problem) -> None:
    photos = tmp_path / "photos"
    for name in NAMES:
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (640, 480), "red").save(photos / name)
    folder = export(tmp_path, problem, undistort=True)
    model = pycolmap.Reconstruction(str(folder / "undistorted" / "sparse" / "0"))
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_reg_images() == COUNT - 1
    assert model.num_points3D() == len(problem.points)
    assert len(list((folder / "undistorted" / "images").rglob("*.jpg"))) == COUNT - 1
    assert not (folder / "undistorted" / "masks").exists()
    export(tmp_path, problem)
    assert not (folder / "undistorted").exists()


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


def test_the_binary_files_have_the_layout_of_colmap_3(tmp_path, problem) -> None:
    sparse = export(tmp_path, problem) / "sparse" / "0"
    cameras = (sparse / "cameras.bin").read_bytes()
    assert struct.unpack_from("<QiiQQ4d", cameras) == (2, 1, 2, 640, 480, *CAMERA.params)
    images = (sparse / "images.bin").read_bytes()
    count, image_id, *pose, camera_id = struct.unpack_from("<Qi7di", images)
    assert (count, image_id, camera_id) == (COUNT - 1, 1, 1)
    assert pose[4:] == pytest.approx(problem.translations[0])
    name = images[72 : images.index(b"\0", 72)]
    assert name.decode() == NAMES[0]
    points = (sparse / "points3D.bin").read_bytes()
    count, point_id, *xyz, red, green, blue, error, length = struct.unpack_from("<QQ3d3BdQ", points)
    assert (count, point_id, red, green, blue) == (len(problem.points), 1, 0, 1, 2)
    assert xyz == pytest.approx(problem.points[0])
    assert error == pytest.approx(0.1)
    assert 1 <= length <= COUNT
