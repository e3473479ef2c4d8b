"""Cameras of two focal lengths whose images tell one of them alone."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from synthetic_scene import run_rounds, side_by_side, true_model

from snakesfm.bundle import rounds
from snakesfm.bundle.focal_pairs import (
    ONE_FOCAL_MODELS,
    find_square_cameras,
    find_stretched_cameras,
    skewed_cameras,
    with_one_focal,
    with_two_focals,
)
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.model import to_reconstruction
from snakesfm.bundle.rounds import bundle_adjuster
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import angle_of
from snakesfm.synthetic import layouts
from snakesfm.synthetic.problems import make_problem

PIXELS = np.random.default_rng(0).uniform([0, 0], [640, 480], (50, 2))


def camera_of(model, fx, fy, terms=()):
    count = len(pycolmap.Camera.create_from_model_name(1, model, fx, 640, 480).params)
    return Camera(
        model, 640, 480, (fx, fy, 320.0, 240.0, *terms, *[0.0] * (count - 4 - len(terms))), "exif"
    )


@pytest.mark.parametrize("model", sorted(ONE_FOCAL_MODELS))
def test_one_focal_length_and_back_is_the_same_lens(model):
    terms = () if model == "PINHOLE" else (0.05, -0.02)
    camera = camera_of(model, 500.0, 500.0, terms)
    one = with_one_focal(camera)
    assert one.model == ONE_FOCAL_MODELS[model]
    assert one.source == "exif"
    np.testing.assert_allclose(one.normalize(PIXELS), camera.normalize(PIXELS), atol=1e-9)
    again = with_two_focals(one, model)
    assert again == camera


def test_only_focal_lengths_that_were_one_and_came_apart_are_tied():
    starts = [
        camera_of("OPENCV", 500.0, 500.0),
        camera_of("OPENCV", 500.0, 500.0),
        camera_of("PINHOLE", 500.0, 450.0),
        Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.0), "exif"),
        camera_of("OPENCV_FISHEYE", 300.0, 300.0),
    ]
    found = [(520.0, 515.0), (520.0, 480.0), (520.0, 430.0), None, (300.0, 320.0)]
    reconstruction = pycolmap.Reconstruction()
    for row, (start, focals) in enumerate(zip(starts, found, strict=True)):
        params = start.params if focals is None else (*focals, *start.params[2:])
        reconstruction.add_camera_with_trivial_rig(replace(start, params=params).to_pycolmap(row + 1))
    assert skewed_cameras(reconstruction, starts) == [2, 5]


@pytest.mark.parametrize(("fy", "serves"), [(499.0, True), (485.0, False)])
def test_one_focal_length_serves_where_errors_stay_as_they_are(fy, serves):
    # square pixels raise the mean error from 0.77 px to 1.23 px
    made = make_problem(12, 120, "area", noise_px=1.0, camera=camera_of("PINHOLE", 500.0, fy), seed=3)
    reconstruction = to_reconstruction(true_model(made), made.keypoints, [f"{k}.jpg" for k in range(12)])
    adjust = bundle_adjuster("ceres")
    adjust(reconstruction, SolverSettings())
    found = find_square_cameras(reconstruction, [1], adjust, SolverSettings())
    assert [camera.model for camera in found.values()] == ["SIMPLE_PINHOLE"] * serves
    assert reconstruction.camera(1).model_name == "PINHOLE"


def upright_ring(camera_count, point_count, rng):
    """A turntable: cameras on a circle, at one height, that all look at the axis."""
    angle = 2.0 * np.pi * np.arange(camera_count) / camera_count
    centers = 4.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros(camera_count)], axis=1)
    normals = rng.normal(size=(point_count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * rng.uniform(1.2, 1.8, (point_count, 1))
    rotations = layouts.look_at(centers, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return layouts.Scene(rotations, centers, points, normals)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_upright_cameras_around_an_object_get_one_focal_length(model, monkeypatch):
    monkeypatch.setitem(layouts.LAYOUTS, "ring", upright_ring)
    true, start = camera_of(model, 500.0, 500.0), camera_of(model, 550.0, 550.0)
    made = make_problem(16, 800, "ring", noise_px=0.3, camera=true, seed=3)
    found, records = run_rounds(made, replace(true_model(made), cameras=(start,)))
    fx, fy = found.cameras[0].params[:2]
    assert found.cameras[0].model == model
    assert fx == fy == pytest.approx(500.0, rel=0.01)
    assert [record.name for record in records][-1] == "last pass with one focal length"


def test_the_pass_with_one_focal_length_has_the_loss_of_the_noise(monkeypatch):
    monkeypatch.setitem(layouts.LAYOUTS, "ring", upright_ring)
    true, start = camera_of("PINHOLE", 500.0, 500.0), camera_of("PINHOLE", 550.0, 550.0)
    made = make_problem(16, 800, "ring", noise_px=0.3, camera=true, seed=3)
    passes = []

    def adjuster(solver):
        adjust = bundle_adjuster(solver)

        def record(reconstruction, solving):
            passes.append((reconstruction.camera(1).model_name, solving.loss_scale_px))
            return adjust(reconstruction, solving)

        return record

    monkeypatch.setattr("snakesfm.bundle.rounds.bundle_adjuster", adjuster)
    _, records = run_rounds(made, replace(true_model(made), cameras=(start,)))
    assert records[-1].name == "last pass with one focal length"
    (trial, tried), (last, used) = passes[-2:]
    assert trial == last == "SIMPLE_PINHOLE"
    assert used == tried
    # 3.5 deviations of the keypoints' noise
    assert 0.8 < used / (3.5 * 0.3) < 1.25


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
@pytest.mark.parametrize("fy", [480.0, 400.0])
def test_pixels_that_are_not_square_stay_so(model, fy):
    true, start = camera_of(model, 500.0, fy), camera_of(model, 500.0, 500.0)
    made = make_problem(16, 800, "area", noise_px=0.3, camera=true, seed=3)
    found, records = run_rounds(made, replace(true_model(made), cameras=(start,)))
    np.testing.assert_allclose(found.cameras[0].params[:2], (500.0, fy), rtol=0.01)
    assert records[-1].name == "last pass"


@pytest.mark.parametrize(
    ("layout", "fy", "name"),
    [("ring", 500.0, "last pass with one focal length"), ("area", 450.0, "last pass")],
)
def test_a_lens_that_was_found_out_gets_one_focal_length_as_well(layout, fy, name, monkeypatch):
    monkeypatch.setitem(layouts.LAYOUTS, "ring", upright_ring)
    wider = camera_of("OPENCV_FISHEYE", 500.0, 0.95 * fy)
    monkeypatch.setattr(rounds, "find_wider_lenses", lambda *_: {1: wider})
    true = camera_of("OPENCV_FISHEYE", 500.0, fy)
    made = make_problem(16, 800, layout, noise_px=0.3, camera=true, seed=3)
    start = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.0), "estimated")
    settings = {"widen_lenses": True, "refine_principal_points": False}
    found, records = run_rounds(made, replace(true_model(made), cameras=(start,)), **settings)
    np.testing.assert_allclose(found.cameras[0].params[:2], (500.0, fy), rtol=0.01)
    assert (found.cameras[0].model, records[-1].name) == ("OPENCV_FISHEYE", name)


def two_cameras(made, second, count):
    """A problem whose last images are by another camera: the cameras of the images."""
    return replace(
        made,
        camera_ids=np.repeat([0, 1], [made.image_count - count, count]),
        cameras=(made.cameras[0], second),
    )


def test_each_camera_is_tied_by_its_own_errors(monkeypatch):
    monkeypatch.setitem(layouts.LAYOUTS, "ring", upright_ring)
    upright, stretched = camera_of("PINHOLE", 500.0, 500.0), camera_of("PINHOLE", 500.0, 450.0)
    parts = [
        make_problem(16, 800, layout, noise_px=0.3, camera=camera, seed=3)
        for layout, camera in (("ring", upright), ("area", stretched))
    ]
    made = two_cameras(side_by_side(*parts), stretched, 16)
    reconstruction = to_reconstruction(true_model(made), made.keypoints, [f"{k}.jpg" for k in range(32)])
    adjust = bundle_adjuster("ceres")
    adjust(reconstruction, SolverSettings())
    assert list(find_square_cameras(reconstruction, [1, 2], adjust, SolverSettings())) == [1]


def stretched(fy, layout="area", held=frozenset(), **changes):
    """What rounds make of a camera of one focal length: it, the rounds' names and the largest rotation error."""
    made = make_problem(
        16, 800, layout, noise_px=0.1, camera=camera_of("OPENCV", 500.0, fy, (-0.05,)), seed=3
    )
    start = Camera("SIMPLE_RADIAL", 640, 480, (480.0, 320.0, 240.0, 0.0), "estimated")
    settings = {"widen_lenses": True, "refine_principal_points": False} | changes
    model = replace(true_model(made), cameras=(start,))
    found, records = run_rounds(made, model, SolverSettings(constant_cameras=held), **settings)
    relative = found.rotations[1:] @ found.rotations[:-1].transpose(0, 2, 1)
    truth = made.rotations[1:] @ made.rotations[:-1].transpose(0, 2, 1)
    errors_deg = np.degrees(angle_of(relative @ truth.transpose(0, 2, 1)))
    return found.cameras[0], [record.name for record in records], float(errors_deg.max())


@pytest.mark.parametrize("fy", [450.0, 600.0])
def test_images_that_were_stretched_are_found_out(fy):
    camera, names, error_deg = stretched(fy)
    assert (camera.model, camera.source) == ("OPENCV", "estimated")
    np.testing.assert_allclose(camera.params[:2], (500.0, fy), rtol=0.01)
    assert "round 2 with wider lenses" in names
    _, _, bent_deg = stretched(fy, widen_lenses=False)
    assert error_deg < 0.1 < 0.5 < bent_deg


def test_stretched_pixels_of_a_camera_gone_wild_later_stay_stretched():
    camera, names, _ = stretched(450.0, max_distortion=1e-9)
    assert "round 2 with wider lenses" in names
    assert camera.params[1] / camera.params[0] == pytest.approx(0.9, rel=0.01)


@pytest.mark.parametrize(
    "case",
    [
        {"fy": 500.0},
        # calibrated lenses stay within it
        {"fy": 505.0},
        # cameras that stand upright do not tell the second
        {"fy": 450.0, "layout": "ring"},
        {"fy": 450.0, "held": frozenset([1])},
        {"fy": 450.0, "widen_lenses": False},
    ],
    ids=["square", "hardly", "upright", "held", "switched off"],
)
def test_other_pixels_stay_square(case, monkeypatch):
    monkeypatch.setitem(layouts.LAYOUTS, "ring", upright_ring)
    camera, names, _ = stretched(**case)
    assert camera.model == "SIMPLE_RADIAL"
    assert not any("lenses" in name for name in names)


def test_few_stretched_images_are_found_out_beside_many_others():
    # one focal length leaves 1.9 of the errors of the last six images, and 1.15 of all
    made = make_problem(40, 2000, "area", noise_px=1.0, camera=camera_of("OPENCV", 500.0, 500.0), seed=3)
    for points in made.keypoints[-6:]:
        points[:] = points * [1.0, 0.97] + [0.0, 0.03 * 240.0]
    start = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.0), "estimated")
    model = true_model(two_cameras(replace(made, cameras=(start,)), start, 6))
    reconstruction = to_reconstruction(model, made.keypoints, [f"{k}.jpg" for k in range(40)])
    adjust, solving = bundle_adjuster("ceres"), SolverSettings(loss_scale_px=3.0)
    adjust(reconstruction, solving)
    ((camera_id, camera),) = find_stretched_cameras(reconstruction, adjust, solving).items()
    assert (camera_id, camera.model) == (2, "OPENCV")
    np.testing.assert_allclose(camera.params[1] / camera.params[0], 0.97, rtol=0.005)
