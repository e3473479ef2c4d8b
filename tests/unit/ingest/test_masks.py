"""What counts as black in a mask, whatever the depth it is stored in."""

import cv2
import numpy as np
import pytest
from PIL import Image

from snakesfm.ingest.masks import read_mask

HEIGHT, WIDTH = 60, 80
IDS = np.zeros((HEIGHT, WIDTH), np.uint16)
IDS[10:20], IDS[20:30], IDS[30:40] = 1, 255, 40_000
BLUE = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
BLUE[10:40, :, 2] = 1
OPAQUE = np.uint16(0xFFFF) * (IDS > 1)


@pytest.mark.parametrize(
    ("stored", "first"),
    [
        (IDS, 10),
        (np.dstack([IDS, 0 * IDS, 0 * IDS]), 10),
        (np.dstack([0 * IDS, 0 * IDS, IDS, OPAQUE]), 20),
        (np.uint8(IDS > 0), 10),
        (BLUE[..., ::-1], 10),
    ],
    ids=["16 bits", "16 bits in one colour", "transparent", "8 bits", "one level of blue"],
)
def test_every_number_but_0_is_wanted(tmp_path, stored: np.ndarray, first: int) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), stored)
    wanted = read_mask(tmp_path / "mask.png", (WIDTH, HEIGHT))
    assert wanted.dtype == bool and wanted.shape == (HEIGHT, WIDTH)
    assert wanted[first:40].all() and not wanted[:first].any() and not wanted[40:].any()


def test_masks_of_floating_point_numbers_are_black_at_0_and_where_nothing_is(tmp_path) -> None:
    stored = np.where(IDS > 255, 1.0, np.where(IDS > 1, 1e-4, 0.0)).astype(np.float32)
    stored[50:] = np.nan
    Image.fromarray(stored).save(tmp_path / "mask.png", format="TIFF")
    wanted = read_mask(tmp_path / "mask.png", (WIDTH, HEIGHT))
    assert wanted[20:40].all() and not wanted[:20].any() and not wanted[40:].any()


def test_the_darkest_gray_is_wanted(tmp_path) -> None:
    gray = np.tile(np.arange(WIDTH) % 2, (HEIGHT, 1)).astype(np.uint8)
    Image.fromarray(gray).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", (WIDTH, HEIGHT)), gray == 1)
