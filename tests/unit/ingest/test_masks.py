"""Masks: what is black is not wanted, and nothing else is."""

import numpy as np
from PIL import Image

from snakesfm.ingest.masks import read_mask


def test_all_but_black_is_wanted(tmp_path):
    gray = np.zeros((48, 64), np.uint8)
    gray[:, ::2] = 1
    Image.fromarray(gray).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", (128, 96)), gray == 1)
