"""Rendered images, of which some overlap."""

import cv2
import numpy as np
import pytest
from image_stages import SHIFT, texture


@pytest.fixture(scope="session")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    wide = texture(1, 260, 360)
    pictures = {
        "a/1 #{x}.png": wide[:240, :320],
        "b/ü 2.png": wide[SHIFT[1] : 240 + SHIFT[1], SHIFT[0] : 320 + SHIFT[0]],
        "flat.png": np.full((240, 320), 128, np.uint8),
        "other.png": texture(2),
        "shifted.png": wide[4:244, 12:332],
    }
    noise = np.random.default_rng(5)
    for name, picture in pictures.items():
        path = folder / name
        if name != "flat.png":
            picture = np.clip(picture + noise.normal(scale=2, size=picture.shape), 0, 255).astype(np.uint8)
        path.parent.mkdir(exist_ok=True)
        # red, green and blue differ, and gray is nearly the picture
        colored = (picture[..., None] * (0.3, 1.0, 0.9)).astype(np.uint8)
        path.write_bytes(cv2.imencode(".png", colored)[1].tobytes())
    (folder / "gone.png").write_bytes(b"\x89PNG no image")
    return folder
