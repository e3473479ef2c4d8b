"""Images and cameras in the pixels that the detector saw."""

import numpy as np
import pytest

from snakesfm.geometry.camera import Camera
from snakesfm.geometry.detector_pixels import (
    detector_scales,
    reduce_cameras,
    reduce_keypoints,
    restore_cameras,
)

SIZES = np.array([[4000, 3000], [3000, 4000], [760, 570], [1520, 1140]])
CAMERAS = [
    Camera("SIMPLE_RADIAL", 4000, 3000, (3500.0, 2000.0, 1500.0, 0.05)),
    Camera("OPENCV", 3000, 4000, (3500.0, 3400.0, 1500.0, 2000.0, 0.1, -0.02, 1e-3, -1e-3), "exif"),
    Camera("PINHOLE", 640, 480, (600.0, 610.0, 320.0, 240.0), "default"),
]
SETTINGS = {"detector_shorter_side_px": 760}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"detector_shorter_side_px": 760}, [3000 / 760, 3000 / 760, 1.0, 1.5]),
        ({"detector_longer_side_px": 800}, [5.0, 5.0, 1.0, 1.9]),
        ({}, [1.0, 1.0, 1.0, 1.0]),
    ],
    ids=["shorter side", "longer side", "as they are"],
)
def test_how_many_pixels_a_detector_pixel_is_wide(settings: dict[str, int], expected: list[float]) -> None:
    np.testing.assert_allclose(detector_scales(SIZES, settings), expected, rtol=1e-15)
    assert len(detector_scales(np.zeros((0, 2)), settings)) == 0


def test_long_images_are_scaled_down_no_further_than_a_matcher_sees_something() -> None:
    sizes = np.array([[16_000, 1000], [1000, 16_000], [4000, 3000], [2000, 40]])
    scales = detector_scales(sizes, {"detector_longer_side_px": 840})
    np.testing.assert_allclose(scales, [1000 / 64, 1000 / 64, 4000 / 840, 1.0], rtol=1e-15)


def test_reduced_cameras_project_to_reduced_pixels() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)), np.ones(50)])
    scales = detector_scales(np.array([(c.width, c.height) for c in CAMERAS]), SETTINGS)
    for camera, small, scale in zip(CAMERAS, reduce_cameras(CAMERAS, SETTINGS), scales, strict=True):
        pixels = camera.to_pycolmap().img_from_cam(points)
        np.testing.assert_allclose(small.to_pycolmap().img_from_cam(points), pixels / scale, rtol=1e-12)
        assert min(small.width, small.height) == min(760, camera.width, camera.height)
        assert (small.model, small.source) == (camera.model, camera.source)


def test_restored_cameras_are_the_originals_but_for_what_changed() -> None:
    small = reduce_cameras(CAMERAS, SETTINGS)
    assert restore_cameras(small, CAMERAS, SETTINGS) == CAMERAS
    small[1] = small[1].with_focal(2.0 * small[1].focal_px, "estimated")
    first, second, third = restore_cameras(small, CAMERAS, SETTINGS)
    assert (first, third) == (CAMERAS[0], CAMERAS[2])
    assert (second.width, second.height, second.source) == (3000, 4000, "estimated")
    expected = (7000.0, 6800.0, *CAMERAS[1].params[2:])
    np.testing.assert_allclose(second.params, expected, rtol=1e-14)


def test_keypoints_keep_their_type_and_small_images_their_keypoints() -> None:
    keypoints = np.random.default_rng(1).uniform(0, 3000, (20, 2)).astype(np.float32)
    reduced = reduce_keypoints(keypoints, 4.0)
    assert reduced.dtype == np.float32
    np.testing.assert_array_equal(reduced * 4, keypoints)
    assert reduce_keypoints(keypoints, 1.0) is keypoints
