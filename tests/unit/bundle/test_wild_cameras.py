"""Which intrinsics are no longer plausible, and what cameras get instead."""

from dataclasses import replace

import cv2  # noqa: F401
import pycolmap
import pytest
from synthetic_scene import true_model

from snakesfm.bundle.model import to_reconstruction
from snakesfm.bundle.wild_cameras import equivalent_distortion, reset_wild_cameras
from snakesfm.geometry.camera import Camera
from snakesfm.synthetic.problems import make_problem

NAMES = [f"{k}.jpg" for k in range(4)]
CENTER = (320.0, 240.0)
LIMITS = (3.0, 15.0, 1.0)


def holding(camera):
    made = make_problem(4, 50, seed=5)
    return to_reconstruction(replace(true_model(made), cameras=(camera,)), made.keypoints, NAMES)


def strength(model, focal_px, *terms, size=(640, 480)):
    focals = (focal_px,) if model in ("SIMPLE_RADIAL", "RADIAL") else (focal_px, focal_px)
    params = [*focals, size[0] / 2, size[1] / 2, *terms]
    return equivalent_distortion(pycolmap.Camera(model=model, width=size[0], height=size[1], params=params))


@pytest.mark.parametrize(
    ("params", "source", "cause"),
    [
        ((500.0, *CENTER, 0.1), "exif", None),
        ((1600.0, *CENTER, 0.1), "exif", "focal length"),
        ((1600.0, *CENTER, 0.1), "default", None),
        ((11000.0, *CENTER, 0.1), "estimated", None),
        ((12000.0, *CENTER, 0.1), "estimated", "focal length"),
        ((55.0, *CENTER, 0.1), "estimated", None),
        ((50.0, *CENTER, 0.1), "estimated", "focal length"),
        ((500.0, *CENTER, -0.99), "default", None),
        ((500.0, *CENTER, -1.01), "default", "distortion"),
        ((300.0, *CENTER, 0.99), "default", None),
        ((300.0, *CENTER, 1.01), "default", "distortion"),
        ((5000.0, *CENTER, -42.0), "default", None),
        ((5000.0, *CENTER, -43.0), "default", "distortion"),
    ],
)
def test_wild_cameras_are_reset(params, source, cause):
    start = Camera("SIMPLE_RADIAL", 640, 480, (500.0, *CENTER, 0.0), source)
    reconstruction = holding(replace(start, params=params))
    found = reset_wild_cameras(reconstruction, [start], {1: start.params}, *LIMITS)
    assert found == ({1: cause} if cause else {})
    assert tuple(reconstruction.camera(1).params) == (start.params if cause else params)


@pytest.mark.parametrize(
    ("before", "cause_params", "expected"),
    [
        ((510.0, *CENTER, 0.2), (500.0, *CENTER, 1.5), (510.0, *CENTER, 0.2)),
        ((510.0, *CENTER, 1.2), (500.0, *CENTER, 1.5), (500.0, *CENTER, 0.0)),
        ((510.0, *CENTER, 0.2), (12000.0, *CENTER, 0.1), (500.0, *CENTER, 0.0)),
    ],
    ids=["distortion", "wild before, too", "focal length"],
)
def test_wild_distortion_goes_back_to_that_before_the_pass(before, cause_params, expected):
    start = Camera("SIMPLE_RADIAL", 640, 480, (500.0, *CENTER, 0.0), "estimated")
    reconstruction = holding(replace(start, params=cause_params))
    assert reset_wild_cameras(reconstruction, [start], {1: before}, *LIMITS)
    assert tuple(reconstruction.camera(1).params) == expected


def test_a_lens_may_keep_the_distortion_that_it_began_with():
    start = Camera("SIMPLE_RADIAL", 640, 480, (500.0, *CENTER, 1.4), "given")
    reconstruction = holding(replace(start, params=(500.0, *CENTER, 1.39)))
    assert reset_wild_cameras(reconstruction, [start], {1: start.params}, *LIMITS) == {}


@pytest.mark.parametrize(
    ("model", "terms", "least", "most"),
    [
        ("SIMPLE_RADIAL", (-0.3,), 0.3 - 1e-9, 0.3 + 1e-9),
        ("RADIAL", (-0.25, 0.29), 0.15, 0.25),
        ("FULL_OPENCV", (-0.116, 1.037, 0.002, -0.003, -1.533, 0.128, 0.826, -1.634), 0.15, 0.3),
        ("OPENCV_FISHEYE", (0.103, -0.081, 1.759, -1.882), 0.1, 0.2),
        ("RADIAL", (0.0, 5.0), 0.8, 0.9),
        ("RADIAL", (0.0, 7.0), 1.1, 1.3),
        ("OPENCV", (0.0, 0.0, 0.2, 0.0), 1.1, 1.6),
        ("FULL_OPENCV", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -80.0), float("inf"), float("inf")),
        ("RADIAL", (0.0, -4.0), float("inf"), float("inf")),
        ("FOV", (1e-9,), 0.0, 1e-6),
    ],
)
def test_distortion_is_judged_by_what_all_terms_do_together(model, terms, least, most):
    assert least <= strength(model, 500.0, *terms) <= most


def test_a_fold_is_one_up_to_the_corners_of_the_view_of_a_usual_lens():
    terms = (0.0, -2.9)
    assert strength("RADIAL", 768.0, *terms, size=(640, 120)) < 1.0
    assert strength("RADIAL", 768.0, *terms, size=(640, 640)) == float("inf")
