"""Rays of pixels of fisheye lenses, which may see more than the plane z = 1 holds."""

import numpy as np
import pytest

from snakesfm.geometry.camera import Camera


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL_FISHEYE", (400.0, 800.0, 800.0, 0.0)),
        ("RADIAL_FISHEYE", (400.0, 800.0, 800.0, 0.0, 0.0)),
        ("OPENCV_FISHEYE", (400.0, 400.0, 800.0, 800.0, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_pixels_beyond_90_degrees_have_no_ray(model: str, params: tuple[float, ...]) -> None:
    camera = Camera(model, 1600, 1600, params)
    angles = np.radians([0.0, 45.0, 80.0, 89.0, 91.0, 95.0, 105.0])
    rays = camera.normalize(np.column_stack([800.0 + 400.0 * angles, np.full(len(angles), 800.0)]))
    np.testing.assert_allclose(rays[:4, 0], np.tan(angles[:4]), rtol=1e-6, atol=1e-9)
    assert np.isnan(rays[4:]).all()


@pytest.mark.parametrize(("model", "terms"), [("FOV", (1.8,)), ("EUCM", (0.7, 1.1)), ("DIVISION", (-0.3,))])
def test_pixels_of_other_wide_models_beyond_90_degrees_have_no_ray(
    model: str, terms: tuple[float, ...]
) -> None:
    camera = Camera(model, 1600, 1600, (300.0, 300.0, 800.0, 800.0, *terms))
    xs = np.linspace(0.0, 799.0, 400)
    rays = camera.normalize(np.column_stack([800.0 + xs, np.full(len(xs), 800.0)]))
    seen = np.isfinite(rays[:, 0])
    # what has a ray is the middle, and leads back to its pixel
    assert 0.1 < seen.mean() < 0.9 and seen[: seen.sum()].all()
    assert np.all(np.diff(rays[seen, 0]) > 0) and rays[seen, 0].max() > 5.0
    again = camera.to_pycolmap().img_from_cam(np.column_stack([rays[seen], np.ones(seen.sum())]))
    np.testing.assert_allclose(np.asarray(again)[:, 0], 800.0 + xs[seen], atol=1e-3)
