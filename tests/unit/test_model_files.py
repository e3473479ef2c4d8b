"""Models beside which pictures are lost."""

from pathlib import Path

import pytest

from snakesfm.model_files import lacks_pictures


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """The folder of a model, with a link to the images."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").touch()
    folder = tmp_path / "scene" / "export_model"
    folder.mkdir(parents=True)
    (folder / "images").symlink_to("../../images")
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


@pytest.mark.parametrize("part", ["images", "sparse"])
def test_undistorted_pictures_are_missed_where_they_are_wanted(model: Path, part: str) -> None:
    for name in ("images", "sparse"):
        (model / "undistorted" / name).mkdir(parents=True)
    assert not lost(model, undistort=True)
    (model / "undistorted" / part).rmdir()
    assert lost(model, undistort=True) and not lost(model)
