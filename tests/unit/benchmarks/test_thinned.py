"""Thinned image sets: which images, and a reference of these alone."""

import shutil

import pytest
from full_disk import cut_references

from benchmarks.compare.sets import read_sets
from benchmarks.large_photographs import main as render
from benchmarks.thinned import main
from snakesfm.evaluation.colmap_model import read_model


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("data")
    assert render([str(folder), "--images", "5", "--width", "120"]) == 0
    # not every image of a set is in its reference
    (images,) = read_sets(folder, [])
    first = images.image_names()[0]
    shutil.copy(images.images / first, images.images / "0 stray.jpg")
    return folder


def test_every_second_image_that_the_reference_has(data, tmp_path) -> None:
    assert main([str(data), str(tmp_path), "--every", "2", "4", "--least", "3"]) == 0
    (whole,), (thinned,) = read_sets(data, []), read_sets(tmp_path, [])
    assert thinned.name == f"{whole.name}_every_2" and (thinned.known, thinned.truth) == (True, True)
    assert thinned.image_names() == whole.image_names()[1::2]
    before, after = read_model(whole.reference), read_model(thinned.reference)
    assert sorted(image.name for image in after.images.values()) == thinned.image_names()
    poses = {image.name: image.cam_from_world().matrix() for image in before.images.values()}
    for image in after.images.values():
        assert (image.cam_from_world().matrix() == poses[image.name]).all()
        assert (thinned.images / image.name).read_bytes() == (whole.images / image.name).read_bytes()
    # a second run changes nothing
    assert main([str(data), str(tmp_path), "--every", "2", "--least", "3"]) == 0
    assert read_sets(tmp_path, [])[0].image_names() == thinned.image_names()


def test_a_reference_that_the_disk_has_no_room_for_is_no_success(data, tmp_path, monkeypatch) -> None:
    cut_references(monkeypatch, "write_binary", "images.bin")
    with pytest.raises(OSError, match="No space left"):
        main([str(data), str(tmp_path), "--every", "2", "--least", "3"])


def test_what_is_no_set_is_said(tmp_path, capsys) -> None:
    assert main([str(tmp_path), str(tmp_path / "thin"), "--sets", "nowhere"]) == 1
    assert "nowhere is not an image set" in capsys.readouterr().err
