"""Whether a distortion is that of the lens: seen in errors that follow the distance from the principal point."""

import numpy as np
import pytest

from snakesfm.geometry.camera import Camera
from snakesfm.geometry.lens_fit import MAX_MISFIT, LensFit, fit_lenses

TRUE = Camera("RADIAL", 800, 600, (600.0, 400.0, 300.0, -0.2, 0.05))
NOISE_PX = 0.3
COUNT = 5000


def fit_of(
    camera: Camera, count: int = COUNT, images: int = 10, noise_px: float = NOISE_PX
) -> dict[int, LensFit]:
    """Of a camera that claims to have taken what the true one took."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0.0, (800.0, 600.0), (count, 2))
    rays = np.column_stack([TRUE.normalize(pixels), np.ones(count)]) * rng.uniform(2.0, 9.0, (count, 1))
    noisy = pixels + rng.normal(0.0, noise_px, pixels.shape)
    numbers = np.arange(count) % images
    return fit_lenses({4: camera}, np.full(count, 4), numbers, rays, noisy)


def test_the_true_distortion_fits() -> None:
    fit = fit_of(TRUE)[4]
    assert 0.0 < fit.misfit < 0.1
    assert fit.noise_px == pytest.approx(NOISE_PX, rel=0.05)


@pytest.mark.parametrize("k1", [-0.2, 0.0])
def test_another_distortion_does_not(k1: float) -> None:
    other = Camera("SIMPLE_RADIAL", 800, 600, (600.0, 400.0, 300.0, k1))
    assert fit_of(other)[4].misfit > MAX_MISFIT


def test_errors_without_direction_are_no_misfit_however_large() -> None:
    assert fit_of(TRUE, noise_px=5.0)[4].misfit < 0.1


def test_few_images_or_observations_tell_nothing() -> None:
    assert fit_of(TRUE, images=4) == {}
    assert fit_of(TRUE, count=499) == {}
    assert set(fit_of(TRUE, count=500, images=5)) == {4}


def test_errors_along_the_radius_are_no_noise() -> None:
    camera = Camera("PINHOLE", 1000, 800, (900.0, 900.0, 500.0, 400.0))
    rng = np.random.default_rng(0)
    pixels = rng.uniform((50.0, 40.0), (950.0, 760.0), (COUNT, 2))
    in_camera = np.column_stack([camera.normalize(pixels), np.ones(COUNT)])
    outward = (pixels - [500.0, 400.0]) / np.hypot(*(pixels - [500.0, 400.0]).T)[:, None]
    seen = pixels + 2.0 * outward + rng.normal(0.0, 0.2, pixels.shape)
    fit = fit_lenses({1: camera}, np.full(COUNT, 1), np.arange(COUNT) % 10, in_camera, seen)[1]
    assert 0.18 < fit.noise_px < 0.22
    assert 9.0 < fit.misfit < 11.0
