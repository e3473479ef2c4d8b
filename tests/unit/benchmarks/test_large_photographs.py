"""The rendered set of large photographs: alike at all scales, true to its reference, the same every time."""

import cv2
import numpy as np
import pycolmap
import pytest

from benchmarks.compare.sets import read_sets
from benchmarks.large_photographs import dead_leaves, main

IMAGES = 3


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("large")
    assert main([str(folder), "--images", str(IMAGES), "--width", "240"]) == 0
    return folder / "courtyard_240"


@pytest.fixture(scope="module")
def bent_courtyard(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("bent")
    assert main([str(folder), "--images", str(IMAGES), "--width", "240", "--fisheye", "110"]) == 0
    return folder / "courtyard_240_fisheye_110"


def test_leaves_show_about_as_much_at_any_size() -> None:
    image = dead_leaves(np.random.default_rng(5), 1200, 1200).mean(axis=2).astype(np.float32)
    steps = []
    for _ in range(4):
        image = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        steps.append(np.abs(np.diff(image, axis=1)).mean())
    # white noise would lose half at each step, a smooth image double
    assert max(steps) < 1.5 * min(steps)


def test_the_set_is_one_that_the_comparison_reads(courtyard) -> None:
    (image_set,) = read_sets(courtyard.parent, [])
    assert (image_set.name, image_set.known, image_set.truth) == ("courtyard_240", True, True)
    assert len(image_set.image_names()) == IMAGES


@pytest.mark.parametrize(
    ("name", "camera_model"), [("courtyard", "PINHOLE"), ("bent_courtyard", "OPENCV_FISHEYE")]
)
def test_points_of_the_reference_have_one_color_in_all_images(name, camera_model, request) -> None:
    folder = request.getfixturevalue(name)
    model = pycolmap.Reconstruction(str(folder / "reference"))
    assert len(model.images) == IMAGES
    assert [camera.model_name for camera in model.cameras.values()] == [camera_model]
    assert 200 < len(model.points3D) < 4000
    shown: dict[int, list[np.ndarray]] = {}
    for image in model.images.values():
        pixels = cv2.imread(str(folder / "images" / image.name))[:, :, ::-1].astype(float)
        for point in image.points2D:
            if point.has_point3D():
                column, row = point.xy.astype(int)
                shown.setdefault(point.point3D_id, []).append(pixels[row, column])
    within = np.mean([np.std(colors, axis=0).mean() for colors in shown.values()])
    across = np.std([np.mean(colors, axis=0) for colors in shown.values()], axis=0).mean()
    assert within < 0.5 * across


def test_the_same_seed_gives_the_same_images_and_nothing_is_overwritten(
    courtyard, tmp_path, capsys
) -> None:
    arguments = ["--images", str(IMAGES), "--width", "240"]
    assert main([str(tmp_path), *arguments]) == 0
    first, again = courtyard / "images", tmp_path / "courtyard_240" / "images"
    assert [(again / path.name).read_bytes() == path.read_bytes() for path in first.iterdir()] == [
        True
    ] * IMAGES
    assert main([str(tmp_path), *arguments]) == 1
    assert "courtyard_240 is there already" in capsys.readouterr().err
