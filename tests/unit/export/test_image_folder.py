"""The images beside a model: those that EXIF turns are shown as they are stored."""

import numpy as np
import pytest
from PIL import Image

from snakesfm.export.image_folder import place_images

MAKE, ORIENTATION = 0x010F, 0x0112


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "big.tif", "webp"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_nothing_but_the_orientation_of_a_turned_image_changes(tmp_path, suffix, order) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    name = f"turned.{suffix}"
    exif = Image.Exif()
    exif.endian = order
    exif[ORIENTATION], exif[MAKE] = 8, "maker"
    Image.fromarray(np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)).save(
        photos / name, exif=exif, **({"big_tiff": True} if suffix == "big.tif" else {})
    )
    place_images(tmp_path / "images", photos, [name], np.array([8]))
    before, after = ((folder / name).read_bytes() for folder in (photos, tmp_path / "images"))
    # the lower byte of the orientation, and in PNG the four of a checksum
    assert len(before) == len(after)
    assert 1 <= sum(a != b for a, b in zip(before, after, strict=True)) <= (5 if suffix == "png" else 1)
    with Image.open(tmp_path / "images" / name) as image:
        assert (image.getexif()[ORIENTATION], image.getexif()[MAKE]) == (1, "maker")
        image.load()
        assert image.size == (64, 48)


def test_images_without_exif_are_one_link(tmp_path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    place_images(tmp_path / "images", photos, ["a.jpg", "b.jpg"], np.array([0, 1]))
    assert (tmp_path / "images").readlink() == photos.relative_to(tmp_path)


@pytest.mark.parametrize("turned", [1, 6])
@pytest.mark.parametrize("is_link", [False, True])
def test_photographs_that_lie_where_they_would_be_shown_stay(tmp_path, turned, is_link) -> None:
    photos = tmp_path / "images"
    folder = tmp_path / "photos" if is_link else photos
    folder.mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = turned
    Image.new("RGB", (64, 48)).save(folder / "a.jpg", exif=exif)
    if is_link:
        photos.symlink_to(folder)
    before = (photos / "a.jpg").read_bytes()
    place_images(tmp_path / "images", photos, ["a.jpg"], np.array([turned]))
    assert (folder / "a.jpg").read_bytes() == before
    with Image.open(tmp_path / "images" / "a.jpg") as image:
        # one that is a link is made again
        assert image.getexif()[ORIENTATION] == (1 if is_link else turned)


def test_an_orientation_outside_exif_changes_nothing(tmp_path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    xmp = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        b'<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="6"/></rdf:RDF></x:xmpmeta>'
    )
    Image.new("RGB", (64, 48)).save(photos / "a.jpg", xmp=xmp)
    with Image.open(photos / "a.jpg") as image:
        assert image.getexif().get(ORIENTATION) == 6
    place_images(tmp_path / "images", photos, ["a.jpg"], np.array([6]))
    assert (tmp_path / "images" / "a.jpg").read_bytes() == (photos / "a.jpg").read_bytes()
