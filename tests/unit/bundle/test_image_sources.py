"""The images in gray at the sizes at which keypoints are refined."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from snakesfm.bundle.alignment import AlignmentSettings
from snakesfm.bundle.image_sources import open_image_sources
from snakesfm.ingest.read import ImagePixels, read_image

SETTINGS = AlignmentSettings(radius_px=5, min_correlation=0.7, threads=2)


def sources_of(paths: list[Path], sizes: list[tuple[int, int]], side: int, *finenesses: float):
    table = np.array(sizes)

    def read(row: int, shorter: int) -> ImagePixels | None:
        return read_image(paths[row], shorter) if paths[row].exists() else None

    scales = np.maximum(1.0, table.min(axis=1) / side)
    return open_image_sources(read, table, scales, finenesses, SETTINGS)


@pytest.mark.parametrize(
    ("shorter", "finenesses", "radii"),
    [
        (3040, (1.0, 2.0), [5, 8]),
        (3040, (1.0, 2.0, 4.0), [5, 8, 13]),
        (1140, (1.0, 2.0, 4.0), [5, 7]),
        (800, (1.0, 2.0), [5]),
        (480, (1.0, 2.0), [5]),
        (3040, (2.0,), [8]),
        (480, (2.0,), [5]),
    ],
)
def test_finer_images_have_larger_patches_and_small_ones_are_read_once(shorter, finenesses, radii) -> None:
    found = sources_of([Path("none.jpg")] * 3, [(2 * shorter, shorter)] * 3, 760, *finenesses)
    assert [source.settings.radius_px for source in found] == radii
    assert all(source.settings.min_correlation == 0.7 and source.settings.threads == 2 for source in found)


def test_few_large_images_among_small_ones_do_not_make_all_of_them_be_read_again() -> None:
    sizes = [(640, 480)] * 3 + [(4000, 3000)] * 2
    assert len(sources_of([Path("none.jpg")] * 5, sizes, 760, 1.0, 2.0)) == 1


def test_images_are_as_fine_as_asked_for_and_say_how_wide_their_pixels_are(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(0, 255, 2000), (1500, 1)).astype(np.uint8)
    for name in ("large.png", "large.jpg"):
        cv2.imwrite(str(tmp_path / name), ramp)
    cv2.imwrite(str(tmp_path / "small.png"), ramp[:300, :400])
    paths = [tmp_path / name for name in ("large.png", "large.jpg", "small.png")]
    sizes = [(2000, 1500), (2000, 1500), (400, 300)]
    coarse, fine = sources_of(paths, sizes, 375, 1.0, 2.0)
    for row in (0, 1):
        for source, height, width in ((coarse, 375, 1.0), (fine, 750, 0.5)):
            image = source.read_gray(row)
            assert image is not None and image.gray.shape == (height, height * 4 // 3)
            np.testing.assert_allclose(image.scale, width, rtol=1e-12)
            assert source.scales[row] == pytest.approx(width)
            assert np.abs(np.diff(image.gray.mean(axis=0))).max() < 2
    for source in (coarse, fine):
        image = source.read_gray(2)
        assert image is not None and image.gray.shape == (300, 400)
        assert image.scale.tolist() == [1.0, 1.0] and source.scales[2] == 1.0


def test_images_are_held_until_they_are_released(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((100, 120), 7, np.uint8))
    (source,) = sources_of([path], [(120, 100)], 760, 1.0)
    first = source.read_gray(0)
    path.unlink()
    assert first is not None and source.read_gray(0) is first
    source.release()
    assert source.read_gray(0) is None
