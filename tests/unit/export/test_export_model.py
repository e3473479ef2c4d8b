"""export_model on small artifacts with exact truth: COLMAP's files, transforms.json and the summary."""

import json
import resource
import struct

import numpy as np
import pycolmap
import pytest
from finished_model import CAMERA, COUNT, FILES, LOST, NAMES, OVERLAY, export, make_images

from snakesfm.artifacts import Reconstruction
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.stages import export_model
from snakesfm.synthetic.problems import make_problem


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
