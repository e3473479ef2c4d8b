"""Models beside which pictures are lost."""

from pathlib import Path

import pytest

from snakesfm.artifacts import write_json
from snakesfm.model_files import SPARSE_FILES, lacks_pictures


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """The folder of a model of one image and beside another, with a link to the images."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").touch()
    folder = tmp_path / "scene" / "export_model"
    (folder / "sparse" / "1").mkdir(parents=True)
    for name in SPARSE_FILES:
        (folder / "sparse" / "1" / name).touch()
    (folder / "images").symlink_to("../../images")
    write_json(folder / "summary.json", {"registered_images": 1, "images_in_other_models": [5]})
    return folder


def lost(model: Path, link_images: bool = True, undistort: bool = False) -> bool:
    return lacks_pictures(model, link_images, undistort)


def test_a_link_to_the_images_is_missed_where_it_is_wanted(model: Path) -> None:
    assert not lost(model)
    (model / "images").unlink()
    assert lost(model) and lost(model, link_images=False, undistort=True)
    assert not lost(model, link_images=False)
    (model / "images").symlink_to("../../elsewhere")
    assert lost(model)


def test_links_to_single_images_and_masks_must_lead_somewhere(model: Path) -> None:
    (model / "images").unlink()
    (model / "images" / "deep").mkdir(parents=True)
    (model / "images" / "turned.jpg").touch()
    assert not lost(model)
    link = model / "images" / "deep" / "a.jpg"
    link.symlink_to("../../../../images/a.jpg")
    assert not lost(model)
    link.unlink()
    link.symlink_to("../../../images/a.jpg")
    assert lost(model)
    link.unlink()
    (model / "masks").symlink_to("../../masks")
    assert lost(model)
    (model.parents[1] / "masks").mkdir()
    assert not lost(model)


@pytest.mark.parametrize("part", ["images/deep/a.jpg", "sparse/0/images.txt"])
def test_undistorted_pictures_are_missed_where_they_are_wanted(model: Path, part: str) -> None:
    for name in ("images/deep/a.jpg", *(f"sparse/0/{name}" for name in SPARSE_FILES)):
        (model / "undistorted" / name).parent.mkdir(parents=True, exist_ok=True)
        (model / "undistorted" / name).touch()
    assert not lost(model, undistort=True)
    (model / "undistorted" / part).unlink()
    assert lost(model, undistort=True) and not lost(model)


def test_files_of_separate_models_and_a_summary_that_says_how_many_are_missed(model: Path) -> None:
    (model / "sparse" / "1" / "points3D.bin").unlink()
    assert lost(model)
    (model / "sparse" / "1" / "points3D.bin").touch()
    for content in ("", "[]", "{}"):
        (model / "summary.json").write_text(content)
        assert lost(model)
