"""Intrinsics in nerfstudio's names: exact where the terms exist, fitted where they do not."""

import numpy as np
import pytest

from snakesfm.export.nerfstudio import camera_intrinsics, camera_warnings, transforms
from snakesfm.geometry.camera import Camera

SIZE = (640, 480)
NATIVE = {
    "SIMPLE_PINHOLE": ((500.0, 320.0, 240.0), {}),
    "PINHOLE": ((500.0, 510.0, 320.0, 240.0), {}),
    "SIMPLE_RADIAL": ((500.0, 320.0, 240.0, -0.1), {"k1": -0.1}),
    "RADIAL": ((500.0, 320.0, 240.0, -0.1, 0.02), {"k1": -0.1, "k2": 0.02}),
    "OPENCV": (
        (500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, 2e-3),
        {"k1": -0.1, "k2": 0.02, "p1": 1e-3, "p2": 2e-3},
    ),
    "FULL_OPENCV": (
        (500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, 2e-3, 0.01, 0.0, 0.0, 0.0),
        {"k1": -0.1, "k2": 0.02, "p1": 1e-3, "p2": 2e-3, "k3": 0.01},
    ),
    "SIMPLE_RADIAL_FISHEYE": ((300.0, 320.0, 240.0, 0.01), {"k1": 0.01}),
    "OPENCV_FISHEYE": (
        (300.0, 310.0, 320.0, 240.0, 0.01, 0.002, 1e-4, 1e-5),
        {"k1": 0.01, "k2": 0.002, "k3": 1e-4, "k4": 1e-5},
    ),
}


def distort(content: dict, rays: np.ndarray) -> np.ndarray:
    """Pixels of points on the plane z = 1 as nerfstudio's readers understand the terms (OpenCV's)."""
    x, y = rays.T
    r2 = x**2 + y**2
    if content["camera_model"] == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        scale = theta * (1 + sum(content[f"k{k}"] * theta ** (2 * k) for k in (1, 2, 3, 4))) / r
        u, v = x * scale, y * scale
    else:
        radial = 1 + content["k1"] * r2 + content["k2"] * r2**2 + content["k3"] * r2**3
        u = x * radial + 2 * content["p1"] * x * y + content["p2"] * (r2 + 2 * x**2)
        v = y * radial + content["p1"] * (r2 + 2 * y**2) + 2 * content["p2"] * x * y
    return np.column_stack([content["fl_x"] * u + content["cx"], content["fl_y"] * v + content["cy"]])


def largest_gap(camera: Camera) -> float:
    pixels = np.random.default_rng(0).uniform(0, 1, (200, 2)) * SIZE
    return float(np.abs(distort(camera_intrinsics(camera), camera.normalize(pixels)) - pixels).max())


@pytest.mark.parametrize("model", sorted(NATIVE))
def test_terms_with_a_name_are_copied_and_project_alike(model) -> None:
    params, terms = NATIVE[model]
    camera = Camera(model, *SIZE, params)
    content = camera_intrinsics(camera)
    for name, value in terms.items():
        assert content[name] == value
    assert (content["w"], content["h"], content["cx"]) == (640, 480, 320.0)
    assert largest_gap(camera) < 1e-3
    assert camera_warnings(camera, 1) == {}


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("FOV", (500.0, 500.0, 320.0, 240.0, 0.6)),
        ("SIMPLE_DIVISION", (500.0, 320.0, 240.0, -0.2)),
        ("DIVISION", (500.0, 510.0, 320.0, 240.0, 0.1)),
        ("FULL_OPENCV", (500.0, 510.0, 320.0, 240.0, 0.1, 0.02, 1e-3, 2e-3, 0.01, 0.15, 0.01, 0.001)),
        (
            "THIN_PRISM_FISHEYE",
            (300.0, 310.0, 320.0, 240.0, 0.01, 0.002, 0.0, 0.0, 1e-4, 1e-5, 1e-4, 1e-4),
        ),
    ],
)
def test_other_models_are_approximated_below_half_a_pixel(model, params) -> None:
    camera = Camera(model, *SIZE, params)
    gap = largest_gap(camera)
    assert 0 < gap < 0.5
    assert camera_warnings(camera, 1) == {}


@pytest.mark.parametrize(
    ("model", "params", "most_px"),
    [
        ("FOV", (256.9, 256.7, 319.7, 242.1, 0.925), 1e-3),
        ("FOV", (160.0, 160.0, 320.0, 240.0, 1.2), 0.5),
        ("EUCM", (160.0, 160.0, 320.0, 240.0, 0.6, 1.1), 0.1),
        ("SIMPLE_DIVISION", (250.0, 320.0, 240.0, -0.6), 0.5),
        (
            "THIN_PRISM_FISHEYE",
            (150.0, 150.0, 320.0, 240.0, 0.02, 0.01, 0.0, 0.0, 1e-3, 5e-4, 0.0, 0.0),
            0.5,
        ),
    ],
)
def test_wide_lenses_are_fisheye_and_fitted_where_the_image_lies_within_them(
    model, params, most_px
) -> None:
    camera = Camera(model, *SIZE, params)
    content = camera_intrinsics(camera)
    assert camera.is_fisheye
    assert content["camera_model"] == "OPENCV_FISHEYE"
    assert 0.8 * params[0] < content["fl_x"] < 1.25 * params[0]
    pixels = np.random.default_rng(0).uniform(0, 1, (400, 2)) * SIZE
    rays = camera.normalize(pixels)
    again = np.asarray(camera.to_pycolmap().img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    within = np.linalg.norm(again - pixels, axis=1) < 0.1
    assert 100 < within.sum() <= 400
    assert np.abs(distort(content, rays[within]) - pixels[within]).max() < most_px
    assert len(camera_warnings(camera, 1)) == (not within.all())


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("EUCM", (30.0, 31.0, 320.0, 240.0, 0.7, 2.0)),
        ("FOV", (30.0, 31.0, 320.0, 240.0, 1.2)),
        ("FULL_OPENCV", (300.0, 300.0, 320.0, 240.0, -4.8, 1.6, 0.0, 0.0, 1.3, -2.6, -3.3, 0.0)),
    ],
)
def test_what_is_no_lens_has_no_terms_and_a_warning(model, params) -> None:
    camera = Camera(model, *SIZE, params)
    content = camera_intrinsics(camera)
    assert (content["fl_x"], content["fl_y"]) == params[:2]
    assert not any(value for name, value in content.items() if name[0] in "kp")
    assert "k1" in content
    warning = camera_warnings(camera, 3)["no distortion"]
    assert warning.startswith(f"camera 3 ({model})")
    assert "transforms.json has none" in warning


def test_a_wide_model_is_of_one_kind_with_fisheye_and_not_with_perspective() -> None:
    wide = Camera("FOV", *SIZE, (300.0, 300.0, 320.0, 240.0, 0.9))
    fisheye = Camera("OPENCV_FISHEYE", *SIZE, NATIVE["OPENCV_FISHEYE"][0])
    perspective = Camera("SIMPLE_RADIAL", *SIZE, NATIVE["SIMPLE_RADIAL"][0])
    for other, kinds in ((fisheye, 1), (perspective, 2)):
        cameras = [wide, other]
        content = transforms(
            ["a.jpg", "b.jpg"],
            np.arange(2),
            cameras,
            np.tile(np.eye(3), (2, 1, 1)),
            np.zeros((2, 3)),
            np.arange(2),
            {},
        )
        assert len({frame["camera_model"] for frame in content["frames"]}) == kinds
        assert len({camera.is_fisheye for camera in cameras}) == kinds
        assert content["frames"][0]["camera_model"] == "OPENCV_FISHEYE"


def test_distortion_that_folds_is_warned_of() -> None:
    camera = Camera("SIMPLE_RADIAL", *SIZE, (300.0, 320.0, 240.0, -1.2))
    (warning,) = camera_warnings(camera, 7).values()
    assert "camera 7" in warning
    assert "not invertible" in warning


def test_a_distortion_that_folds_is_fitted_where_pixels_have_rays() -> None:
    terms = (-1.2, 0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0)
    camera = Camera("FULL_OPENCV", *SIZE, (300.0, 300.0, 320.0, 240.0, *terms))
    content = camera_intrinsics(camera)
    assert -1.5 < content["k1"] < -0.5
    assert 250.0 < content["fl_x"] < 350.0


def test_a_distortion_that_cannot_be_written_says_by_how_much() -> None:
    terms = (0.0, 0.0, 0.01, 0.01, 0.0, 0.0, 0.0, 0.0)
    camera = Camera("THIN_PRISM_FISHEYE", *SIZE, (300.0, 300.0, 320.0, 240.0, *terms))
    (warning,) = camera_warnings(camera, 1).values()
    assert "approximates" in warning


def test_one_camera_stands_at_the_top_and_several_in_the_frames() -> None:
    cameras = [Camera("PINHOLE", *SIZE, (500.0, 500.0, 320.0, 240.0)) for _ in range(2)]
    rotations, translations = np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))
    names = ["b.jpg", "a.jpg", "c.jpg"]
    one = transforms(names, np.zeros(3, int), cameras, rotations, translations, np.array([0, 1, 2]), {})
    assert one["fl_x"] == 500.0
    assert "fl_x" not in one["frames"][0]
    assert [frame["file_path"] for frame in one["frames"]] == [
        "images/a.jpg",
        "images/b.jpg",
        "images/c.jpg",
    ]
    two = transforms(names, np.array([0, 0, 1]), cameras, rotations, translations, np.array([0, 2]), {})
    assert "fl_x" not in two
    assert all(frame["fl_x"] == 500.0 for frame in two["frames"])
