"""export_model, evaluate_model and render_report on small artifacts with exact truth."""

import csv
import dataclasses
import html
import json
import struct
import sys
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from snakesfm.artifacts import (
    CalibratedCameras,
    CameraRotations,
    Header,
    ImageIndex,
    LocalFeatures,
    Reconstruction,
    TrackTable,
    TriangulatedPoints,
    TwoViewGeometries,
    ViewGraph,
    write_json,
)
from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.config.export_model import ExportModelOptions
from snakesfm.config.render_report import RenderReportOptions
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.export.undistorted import write_undistorted
from snakesfm.geometry.camera import Camera, cameras_to_columns
from snakesfm.geometry.earth import local_metres, local_origin
from snakesfm.job_logs import describe_cost
from snakesfm.stages import evaluate_model, export_model, render_report
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import SyntheticProblem, make_problem

COUNT = 9
LOST = 8
OVERLAY = "5.0 % of the images of a size show the same."
ORIENTATION = 0x0112
FILES = (
    "sparse/0/cameras.bin",
    "sparse/0/images.bin",
    "sparse/0/points3D.bin",
    "sparse/0/cameras.txt",
    "sparse/0/images.txt",
    "sparse/0/points3D.txt",
    "points.ply",
    "transforms.json",
    "summary.json",
)
HEADER = Header("test", 1, "scene", '{"an": "option"}')
NAMES = sorted(f"day 1/ü{k}#<b>{{}}.jpg" for k in range(COUNT))


@pytest.fixture(scope="module")
def problem() -> SyntheticProblem:
    return make_problem(camera_count=COUNT, point_count=300, noise_px=0.3, camera=CAMERA)


CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.02))


def write_index(
    folder: Path, orientations: np.ndarray | None = None, gps: np.ndarray | None = None
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    models, sizes, params, sources = cameras_to_columns([CAMERA, CAMERA])
    ImageIndex(
        names=NAMES,
        sizes=np.tile([640, 480], (COUNT, 1)),
        sha256=["0"] * COUNT,
        blocks=np.zeros(COUNT, np.int32),
        camera_ids=np.arange(COUNT) % 2,
        orientations=np.ones(COUNT, np.int32) if orientations is None else orientations,
        focal_exif_px=np.full(COUNT, np.nan),
        gps=np.full((COUNT, 3), np.nan) if gps is None else gps,
        duplicate_of=np.full(COUNT, -1),
        camera_models=models,
        camera_sizes=sizes,
        camera_params=params,
        camera_sources=sources,
        refused_names=["no <image>.jpg"],
        refused_reasons=["It is a text file."],
        warnings=["5 images have a camera each."],
    ).write(folder / "index.h5", HEADER)
    return folder / "index.h5"


def write_cameras(folder: Path, focal_sigma: tuple[float, float] = (0.0, 0.0)) -> Path:
    models, sizes, params, sources = cameras_to_columns([CAMERA, CAMERA])
    CalibratedCameras(
        models, sizes, params, sources, focal_sigma, np.zeros(2, int), np.zeros((0, 4), int), [OVERLAY]
    ).write(folder / "cameras.h5", HEADER)
    return folder / "cameras.h5"


def write_reconstruction(
    folder: Path,
    problem: SyntheticProblem,
    lost: Iterable[int] = (LOST,),
    reset: str = "",
    offset: float = np.nan,
    second: Iterable[int] = (),
) -> Path:
    """The truth as a finished model, ``lost`` images not registered, those of a ``second`` model apart.

    Also what is wrong with the second camera.
    """
    rotations, translations = problem.rotations.copy(), problem.translations.copy()
    rotations[list(lost)], translations[list(lost)] = np.nan, np.nan
    keep = ~np.isin(problem.track_image_ids, list(lost))
    model_of = np.isin(np.arange(COUNT), list(second)).astype(np.int32)
    if model_of.any():
        # every other point is of the second model
        point_of = np.repeat(np.arange(len(problem.points)), np.diff(problem.track_offsets))
        keep &= model_of[problem.track_image_ids] == point_of % 2
    lengths = np.add.reduceat(keep.astype(int), problem.track_offsets[:-1])
    seen = lengths > 0
    models, sizes, params, _ = cameras_to_columns([CAMERA, CAMERA])
    count = int(seen.sum())
    Reconstruction(
        camera_models=models,
        camera_sizes=sizes,
        camera_params=params,
        camera_resets=["", reset],
        camera_offsets=np.array([np.nan, offset]),
        rotations=rotations,
        translations=translations,
        models=np.where(np.isin(np.arange(COUNT), list(lost)), -1, model_of),
        points=problem.points[seen],
        colors=np.arange(count * 3).reshape(-1, 3).astype(np.uint8),
        errors_px=np.linspace(0.1, 0.5, count),
        offsets=np.concatenate([[0], np.cumsum(lengths[seen])]),
        image_ids=problem.track_image_ids[keep],
        keypoint_ids=problem.track_keypoint_ids[keep],
        keypoints=problem.track_keypoints[keep],
        round_names=["10 px", "5 px"],
        round_costs=np.array([[9.0, 4.0], [4.0, 3.5]]),
        round_counts=np.array([[9, 300, 900], [8, 290, 850]]),
        round_errors_px=np.array([0.6, 0.4]),
    ).write(folder / "reconstruction.h5", HEADER)
    return folder / "reconstruction.h5"


def write_features(folder: Path, problem: SyntheticProblem) -> Path:
    """The keypoints a quarter of a pixel from where they were refined to, and one of no point in each image."""
    keypoints = [np.vstack([found + 0.25, [[7.0, 9.0]]]) for found in problem.keypoints]
    counts = [len(found) for found in keypoints]
    total = sum(counts)
    LocalFeatures(
        image_ids=np.arange(COUNT),
        names=NAMES,
        digests=["d"] * COUNT,
        sizes=np.tile([640, 480], (COUNT, 1)),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        keypoints=np.concatenate(keypoints).astype(np.float32),
        descriptors=np.zeros((total, 0), np.uint8),
        scores=np.ones(total, np.float32),
        scales=np.ones(total, np.float32),
        angles=np.zeros(total, np.float32),
        colors=np.zeros((total, 3), np.uint8),
    ).write(folder / "features.h5", HEADER)
    return folder / "features.h5"


def make_images(folder: Path) -> Path:
    for name in NAMES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (64, 48), "red").save(folder / name)
    return folder


def export(
    tmp_path: Path,
    problem: SyntheticProblem,
    orientations: np.ndarray | None = None,
    lost: Iterable[int] = (LOST,),
    gps: np.ndarray | None = None,
    masks: Path | None = None,
    reset: str = "",
    offset: float = np.nan,
    second: Iterable[int] = (),
    **options: bool,
) -> Path:
    inputs = {
        "index": str(write_index(tmp_path, orientations, gps)),
        "cameras": str(write_cameras(tmp_path)),
        "features": [str(write_features(tmp_path, problem))],
        "reconstruction": str(write_reconstruction(tmp_path, problem, lost, reset, offset, second)),
    }
    folder = tmp_path / "out" / "scene" / "export_model"
    images = tmp_path / "photos"
    if not images.exists():
        make_images(images)
    export_model.run(
        StageJob(
            "export_model",
            "scene",
            inputs,
            tuple(folder / file for file in FILES),
            ExportModelOptions(**options),
            {"images": str(images)} | ({"masks": str(masks)} if masks else {}),
        )
    )
    return folder


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


def gps_of(problem: SyntheticProblem, noise_m: float) -> np.ndarray:
    """Positions of a flight: the model turned about its x axis and a hundred times as large."""
    centers = -np.einsum("nji,nj->ni", problem.rotations, problem.translations) * 100.0
    places = centers @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    places += np.random.default_rng(1).normal(size=places.shape) * noise_m
    return pycolmap.GPSTransform().enu_to_ellipsoid(places, 47.0, 8.0, 500.0)


def test_a_model_with_positions_in_exif_is_in_metres_and_the_same_in_all_files(tmp_path, problem) -> None:
    gps = gps_of(problem, 0.5)
    folder = export(tmp_path, problem, gps=gps)
    summary = json.loads((folder / "summary.json").read_text())["georeference"]
    assert summary["images_with_position"] == 8 and 4 <= summary["inliers"] <= 8
    assert 0.05 < summary["median_residual_m"] < 2.0
    model = read_model(folder / "sparse" / "0")
    origin = summary["origin_latitude_longitude_altitude"]
    local = pycolmap.GPSTransform().ellipsoid_to_enu(gps, *origin)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    for frame in frames:
        image = model.images[frame["colmap_im_id"]]
        center = image.projection_center()
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], center, atol=1e-9)
        assert np.linalg.norm(center - local[image.image_id - 1]) < 3.0
    assert 0.2 < model.compute_mean_reprojection_error() < 0.6
    points = {tuple(np.round(point.xyz, 3)) for point in model.points3D.values()}
    cloud = pycolmap.Reconstruction()
    cloud.import_PLY(str(folder / "points.ply"))
    np.testing.assert_allclose(
        sorted(np.round(point.xyz, 3).tolist() for point in cloud.points3D.values()),
        sorted(map(list, points)),
        atol=0.01,
    )


def test_the_world_stays_where_positions_contradict_it_or_are_not_wanted(tmp_path, problem) -> None:
    plain = export(tmp_path / "plain", problem)
    without = (plain / "sparse/0/images.bin").read_bytes()
    for name, noise, options in (("bad", 300.0, {}), ("off", 0.5, {"georeference": False})):
        folder = export(tmp_path / name, problem, gps=gps_of(problem, noise), **options)
        assert (folder / "sparse/0/images.bin").read_bytes() == without
        assert json.loads((folder / "summary.json").read_text())["georeference"] is None
    for unused in (plain, folder):
        summary = json.loads((unused / "summary.json").read_text())
        assert summary["georeference_refused"] is None
        assert not any("georeference" in line for line in summary["warnings"])


def few_positions(gps: np.ndarray) -> None:
    gps[3:] = np.nan


def no_altitudes(gps: np.ndarray) -> None:
    gps[3:, 2] = np.nan


def of_the_lost_image(gps: np.ndarray) -> None:
    gps[np.arange(COUNT) != LOST] = np.nan


def in_another_order(gps: np.ndarray) -> None:
    gps[:LOST] = gps[np.random.default_rng(0).permutation(LOST)]


def within_a_metre(gps: np.ndarray) -> None:
    gps[:] = pycolmap.GPSTransform().enu_to_ellipsoid(
        0.02 * pycolmap.GPSTransform().ellipsoid_to_enu(gps, 47.0, 8.0, 500.0)
        + np.random.default_rng(2).normal(size=gps.shape) * 0.9,
        47.0,
        8.0,
        500.0,
    )


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (few_positions, "only 3 images of the model have GPS in EXIF, and 4 are needed"),
        # of nine images one is not registered
        (
            no_altitudes,
            "5 images of the model have GPS without altitude in EXIF, and fewer than 4 with it",
        ),
        (of_the_lost_image, "no image of the model has GPS in EXIF"),
        (in_another_order, "of 8 positions agree with the model"),
        (within_a_metre, "the positions spread over only"),
    ],
)
def test_why_positions_are_not_used_is_said_everywhere(tmp_path, problem, damage, reason) -> None:
    gps = gps_of(problem, 0.1)
    damage(gps)
    folder = export(tmp_path, problem, gps=gps)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["georeference"] is None
    assert reason in summary["georeference_refused"]
    (line,) = (line for line in summary["warnings"] if "georeferenced" in line)
    assert line == (
        f"The model is not georeferenced by the GPS positions in EXIF: {summary['georeference_refused']}."
    )
    assert html.escape(reason) in report(tmp_path, problem, "", summary=summary)
    wanted = export(tmp_path / "wanted", problem, gps=gps, georeference=True)
    summary = json.loads((wanted / "summary.json").read_text())
    (line,) = (line for line in summary["warnings"] if "georeference is true" in line)
    assert reason in line
    used = damage in (in_another_order, within_a_metre)
    assert (summary["georeference"] is not None) == used == (summary["georeference_refused"] is None)


@pytest.mark.parametrize(
    ("without", "sentence"),
    [
        (
            (),
            "in folders next to sparse/0, all in metres east, north and up from the origin in summary.json.",
        ),
        ((0, 1, 2, 3), "summary.json (georeference_of_models): sparse/1."),
        ((4, 5, 6, 7), "summary.json (georeference_of_models): sparse/0."),
        (range(8), "in folders next to sparse/0, each in its own coordinate frame."),
    ],
)
def test_it_is_told_which_of_separate_models_are_georeferenced(
    tmp_path, problem, without, sentence
) -> None:
    gps = gps_of(problem, 0.05)
    gps[list(without)] = np.nan
    folder = export(tmp_path, problem, gps=gps, second=(4, 5, 6, 7))
    summary = json.loads((folder / "summary.json").read_text())
    first, second = summary["georeference_of_models"]
    assert summary["georeference"] == first
    assert (first is None) == (0 in without)
    assert (second is None) == (4 in without)
    (line,) = (line for line in summary["warnings"] if "could not be connected" in line)
    assert line.startswith("4 images could not be connected") and line.endswith(sentence)
    origin = local_origin(gps)
    page = report(tmp_path, problem, "", summary=summary)
    for number, place in enumerate((first, second)):
        assert (f"<td>sparse/{number}</td>" in page) == (place is not None)
        if place is None:
            continue
        assert place["origin_latitude_longitude_altitude"] == list(origin)
        assert (place["images_with_position"], place["inliers"]) == (4, 4)
        model = read_model(folder / "sparse" / str(number))
        places = local_metres(gps, origin)
        for image in model.images.values():
            assert np.linalg.norm(image.projection_center() - places[image.image_id - 1]) < 1.0


def test_where_no_image_has_gps_that_is_said_only_if_it_is_wanted(tmp_path, problem) -> None:
    asked = export(tmp_path, problem, georeference=True)
    summary = json.loads((asked / "summary.json").read_text())
    assert summary["georeference_refused"] == "no image of the model has GPS in EXIF"
    assert any("georeference is true, but" in line for line in summary["warnings"])


def test_the_report_says_where_the_model_is(tmp_path, problem) -> None:
    folder = export(tmp_path, problem, gps=gps_of(problem, 0.5))
    summary = json.loads((folder / "summary.json").read_text())
    page = report(tmp_path, problem, "", summary=summary)
    latitude, longitude, altitude = summary["georeference"]["origin_latitude_longitude_altitude"]
    assert f"{latitude:.6f}, {longitude:.6f}, {altitude:.2f} m" in page
    assert "<h2>Georeference</h2>" in page
    for kind in ("", "horizontal_", "vertical_"):
        residual = summary["georeference"][f"median_{kind}residual_m"]
        assert 0.05 < residual < 2.0
        assert f"{residual:.4g}" in page
    assert "<h2>Georeference</h2>" not in report(tmp_path / "none", problem, "")


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


@pytest.mark.parametrize(("distortion", "told"), [(0.02, 0), (0.3, 1)])
def test_a_lens_of_another_distortion_is_warned_of(tmp_path, distortion: float, told: int) -> None:
    lens = dataclasses.replace(CAMERA, params=(*CAMERA.params[:3], distortion))
    seen = make_problem(camera_count=COUNT, point_count=3000, noise_px=0.1, camera=lens)
    summary = json.loads((export(tmp_path, seen, lost=()) / "summary.json").read_text("utf-8"))
    # the second camera has but four images
    found = [line for line in summary["warnings"] if "does not describe the lens" in line]
    assert len(found) == told
    assert all(line.startswith("camera 1 (SIMPLE_RADIAL)") for line in found)


@pytest.mark.parametrize(("reset", "told"), [("", 0), ("distortion", 1)])
def test_a_camera_that_was_reset_and_held_is_warned_of(tmp_path, problem, reset: str, told: int) -> None:
    folder = export(tmp_path, problem, reset=reset)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    found = [line for line in summary["warnings"] if "reset and kept fixed" in line]
    assert len(found) == told
    assert all(line.startswith("camera 2 (SIMPLE_RADIAL): its distortion was") for line in found)


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


@pytest.mark.parametrize(
    ("lens", "told"),
    [(CAMERA, 0), (dataclasses.replace(CAMERA, model="FOV", params=(250.0, 250.0, 320.0, 240.0, 1.4)), 2)],
    ids=["usual", "beyond 180 degrees"],
)
def test_pictures_of_which_little_is_left_without_distortion_are_warned_of(
    tmp_path, monkeypatch, lens: Camera, told: int
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "CAMERA", lens)
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
    adjusted = SimpleNamespace(camera_resets=["distortion"] * count, camera_offsets=np.full(count, 0.07))
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
        ("not invertible", "reset and kept fixed", "max_principal_point_offset"): (
            export_model._camera_warnings(adjusted, dict.fromkeys(range(count), folding))
        ),
        ("does not describe the lens",): export_model._lens_warnings(
            one, [folding] * count, np.zeros(1, int)
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
    monkeypatch.setattr(sys.modules[__name__], "CAMERA", lens)
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


def evaluate(
    tmp_path: Path, problem: SyntheticProblem, reference: str, lost: Iterable[int] = (LOST,)
) -> tuple[dict, dict]:
    folder = tmp_path / "evaluate_model"
    inputs = {
        "index": str(write_index(tmp_path)),
        "reconstruction": str(write_reconstruction(tmp_path, problem, lost)),
    }
    evaluate_model.run(
        StageJob(
            "evaluate_model",
            "scene",
            inputs,
            (folder / "metrics.json", folder / "metrics.csv"),
            EvaluateModelOptions(),
            {"reference": reference},
        )
    )
    with (folder / "metrics.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1
    return json.loads((folder / "metrics.json").read_text("utf-8")), rows[0]


def test_evaluation_against_the_exported_truth(tmp_path, problem) -> None:
    truth = export(tmp_path, problem, lost=())
    metrics, row = evaluate(tmp_path, problem, str(truth))
    assert metrics["reference_images"] == COUNT
    assert metrics["reference_images_registered"] == COUNT - 1
    assert metrics["relative_pose_auc_5deg"] == pytest.approx(100 * 8 * 7 / 72, abs=1e-3)
    assert metrics["pose_auc_2.5deg"] == pytest.approx(100 * 8 / 9, abs=1e-3)
    assert metrics["per_image"][NAMES[LOST]]["position_error"] is None
    assert metrics["per_image"][NAMES[0]]["position_error"] == pytest.approx(0.0, abs=1e-6)
    assert float(row["relative_pose_auc_5deg"]) == metrics["relative_pose_auc_5deg"]
    assert set(row) == set(metrics) - {"per_image", "reference"}


def test_evaluation_without_a_reference_has_the_columns_that_need_none(tmp_path, problem) -> None:
    metrics, row = evaluate(tmp_path, problem, "")
    assert metrics["registered_images"] == COUNT - 1
    assert metrics["points"] == len(problem.points)
    assert not [name for name in row if "auc" in name]


def write_former_stages(folder: Path, problem: SyntheticProblem) -> dict[str, object]:
    """What the report reads of the stages before: image LOST has only refused pairs."""
    pairs, edges = problem.pairs, len(problem.pairs)
    lost = (pairs == LOST).any(axis=1)
    TwoViewGeometries(
        pairs=pairs,
        digests=["0"] * edges,
        rotations=problem.edge_rotations,
        translations=problem.edge_translations,
        covariances=problem.edge_covariances,
        kinds=np.zeros(edges, np.int8),
        rejections=np.where(lost, 3, 0),
        match_counts=problem.edge_inlier_counts + 10,
        inlier_counts=problem.edge_inlier_counts,
        inlier_ratios=np.full(edges, 0.5),
        triangulation_angles_deg=problem.edge_angles_deg,
        offsets=problem.match_offsets,
        inliers=problem.matches,
    ).write(folder / "0-0.h5", HEADER)
    kept = ~lost
    ViewGraph(
        pairs=pairs[kept],
        rotations=problem.edge_rotations[kept],
        translations=problem.edge_translations[kept],
        covariances=problem.edge_covariances[kept],
        kinds=np.zeros(kept.sum(), np.int8),
        inlier_counts=problem.edge_inlier_counts[kept],
        triangulation_angles_deg=problem.edge_angles_deg[kept],
        labels=np.where(np.arange(kept.sum()) == 0, 2, 0),
        cycle_min_deg=np.ones(kept.sum()),
        cycle_median_deg=np.ones(kept.sum()),
        components=np.where(np.arange(COUNT) == LOST, 1, 0),
    ).write(folder / "graph.h5", HEADER)
    rotations = problem.rotations.copy()
    rotations[LOST] = np.nan
    CameraRotations(
        rotations=rotations,
        residuals_deg=np.full(kept.sum(), 0.25),
        labels=np.zeros(kept.sum(), np.int8),
        components=np.where(np.arange(COUNT) == LOST, -1, 0),
    ).write(folder / "rotations.h5", HEADER)
    keypoints = problem.track_keypoints
    TrackTable(
        offsets=problem.track_offsets,
        image_ids=problem.track_image_ids,
        keypoint_ids=problem.track_keypoint_ids,
        part_ids=np.repeat(np.arange(len(problem.track_offsets) - 1), np.diff(problem.track_offsets)),
        keypoints=keypoints,
        colors=np.zeros((len(keypoints), 3), np.uint8),
        lengths_unmerged=np.zeros(0, np.int64),
        lengths_merged=np.zeros(0, np.int64),
    ).write(folder / "tracks.h5", HEADER)
    TriangulatedPoints(
        points=problem.points,
        offsets=problem.track_offsets,
        image_ids=problem.track_image_ids,
        keypoint_ids=problem.track_keypoint_ids,
        keypoints=keypoints,
        colors=np.zeros((len(problem.points), 3), np.uint8),
    ).write(folder / "points.h5", HEADER)
    log = folder / "logs" / "match_pairs" / "0-0.log"
    log.parent.mkdir(parents=True)
    log.write_text(describe_cost("match_pairs", 0.0, 12.5, 12.0, 321.0) + "\n", "utf-8")
    write_cameras(folder, (0.02, np.nan))
    names = ("cameras", "graph", "rotations", "tracks", "points", "index", "reconstruction")
    inputs: dict[str, object] = {name: str(folder / f"{name}.h5") for name in names}
    # of a run with more blocks
    (log.parent / "2-3.log").write_text(describe_cost("match_pairs", 0.0, 70.0, 7.0, 9.0) + "\n", "utf-8")
    return {**inputs, "geometries": [str(folder / "0-0.h5")]}


def report(
    tmp_path: Path,
    problem: SyntheticProblem,
    reference: str,
    lost: Iterable[int] = (LOST,),
    summary: dict[str, object] | None = None,
    **options: int,
) -> str:
    evaluate(tmp_path, problem, reference, lost)
    inputs = write_former_stages(tmp_path, problem)
    inputs["metrics"] = str(tmp_path / "evaluate_model" / "metrics.json")
    write_json(tmp_path / "summary.json", summary or {"warnings": ["camera 1: look <here>"]})
    inputs["summary"] = str(tmp_path / "summary.json")
    output = tmp_path / "render_report" / "index.html"
    render_report.run(
        StageJob("render_report", "a <scene>", inputs, (output,), RenderReportOptions(**options))
    )
    return output.read_text("utf-8")


def test_report_says_what_happened_and_escapes_names(tmp_path, problem) -> None:
    page = report(tmp_path, problem, str(export(tmp_path, problem, lost=())))
    assert "8 of 9 images registered" in page
    assert "a &lt;scene&gt;" in page
    assert "#<b>" not in page
    assert "#&lt;b&gt;" in page
    assert "no &lt;image&gt;.jpg" in page
    assert "look &lt;here&gt;" in page
    lost = int((problem.pairs == LOST).any(axis=1).sum())
    assert f"None of its {lost} pairs was accepted: too few inliers ({lost})." in page
    assert "cycle_median" in page
    assert "focal lengths: 2 given; median standard deviation 2.0 %" in page
    assert "12.5" in page and "82.5" not in page
    assert "relative pose AUC" in page
    assert page.count("<title>") >= 2 * 8
    assert "http" not in page.replace("http-equiv", "")
    assert len(page) < 1_000_000


def test_report_without_reference_shows_at_most_the_asked_rows(tmp_path, problem) -> None:
    page = report(tmp_path, problem, "", max_images=3)
    assert "Only the 3 of 9 images with the fewest observations are shown." in page
    assert "relative pose AUC" not in page


def test_a_scene_without_registered_images_is_exported_evaluated_and_reported(tmp_path, problem) -> None:
    everything = range(COUNT)
    truth = export(tmp_path / "truth", problem, lost=())
    folder = export(tmp_path, problem, lost=everything)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    assert (summary["registered_images"], summary["mean_reprojection_error_px"]) == (0, 0.0)
    assert pycolmap.Reconstruction(str(folder / "sparse" / "0")).num_reg_images() == 0
    page = report(tmp_path, problem, str(truth), lost=everything)
    assert "0 of 9 images registered" in page
    assert "No image is registered." in page
    assert "Bundle adjustment dropped it" in page


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
