"""Images and places as EXIF orientations show them."""

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from snakesfm.features.keypoints import KeypointSet, pixels_at
from snakesfm.geometry.orientations import show_pixels, show_places, shown_size, store_places


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_and_places_are_shown_as_pil_shows_them(orientation):
    stored = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
    tagged = Image.fromarray(stored)
    tagged.getexif()[ExifTags.Base.Orientation] = orientation
    expected = np.asarray(ImageOps.exif_transpose(tagged))
    shown = show_pixels(stored, orientation)
    np.testing.assert_array_equal(shown, expected)
    assert shown.flags.c_contiguous and shown_size((7, 5), orientation) == expected.shape[1::-1]
    # (0.75, 0.5) has another value at each of its mirrored and swapped places
    places = np.array([[0.75, 0.5], [6.5, 4.25], [3.0, 1.0]], np.float32)
    there = show_places(places, (7, 5), orientation)
    assert there.dtype == np.float32
    np.testing.assert_array_equal(pixels_at(shown, there[:2]), pixels_at(stored, places[:2]))
    np.testing.assert_array_equal(store_places(there, (7, 5), orientation), places)
    points = KeypointSet(places, *np.zeros((4, 3), np.float32), image_size=(7, 5))
    assert points.shown(orientation).image_size == expected.shape[1::-1]
    back = points.shown(orientation).stored(orientation)
    assert back.image_size == (7, 5)
    np.testing.assert_array_equal(back.keypoints, places)
