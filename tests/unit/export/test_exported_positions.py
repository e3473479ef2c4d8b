"""export_model with positions in EXIF: where the model is, or why they are not used."""

import html
import json

import numpy as np
import pycolmap
import pytest
from finished_model import COUNT, LOST, export, gps_of, report

from snakesfm.evaluation.colmap_model import read_model
from snakesfm.geometry.earth import local_metres, local_origin
from snakesfm.stages import render_report


def test_a_model_with_positions_in_exif_is_in_metres_and_the_same_in_all_files(tmp_path, problem) -> None:
    gps = gps_of(problem, 0.5)
    folder = export(tmp_path, problem, gps=gps)
    summary = json.loads((folder / "summary.json").read_text())["georeference"]
    assert summary["images_with_position"] == 8 and 4 <= summary["inliers"] <= 8
    assert 0.05 < summary["median_residual_m"] < 2.0
    model = read_model(folder / "sparse" / "0")
    origin = summary["origin_latitude_longitude_altitude"]
    local = pycolmap.GPSTransform().ellipsoid_to_enu(gps, *origin)
    content = json.loads((folder / "transforms.json").read_text())
    assert content["orientation_override"] == "none"
    for frame in content["frames"]:
        image = model.images[frame["colmap_im_id"]]
        pose = image.cam_from_world().inverse().matrix()
        np.testing.assert_allclose(frame["transform_matrix"][:3], pose * [1, -1, -1, 1], atol=1e-9)
        assert np.linalg.norm(image.projection_center() - local[image.image_id - 1]) < 3.0
    model.update_point_3d_errors()
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
        assert "orientation_override" not in (unused / "transforms.json").read_text()
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
    without = report(tmp_path / "none", problem, "")
    assert "<h2>Georeference</h2>" not in without
    assert ("From above, north at the top" in page, "north at the top" in without) == (True, False)


def test_the_report_is_drawn_along_east_and_north(tmp_path, problem, monkeypatch) -> None:
    folder = export(tmp_path, problem, gps=gps_of(problem, 0.1))
    summary = json.loads((folder / "summary.json").read_text())
    drawn = []
    monkeypatch.setattr(render_report, "scene_map", lambda *given: (drawn.append(given[-1]), ("", 0))[1])
    report(tmp_path, problem, "", summary=summary)
    # of gps_of: east, north and up in the model
    expected = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    np.testing.assert_allclose(drawn[0], expected, atol=0.01)
    np.testing.assert_allclose(drawn[1], [expected[0], expected[2], np.negative(expected[1])], atol=0.01)
