"""pycolmap, loaded after cv2: in the other order their PNG libraries clash.

All code takes it from here: ``from snakesfm.geometry.colmap_binding import pycolmap``. The two take a tenth
of a second to load, so modules that jobs import without need of them do so inside functions.
"""

import cv2  # noqa: F401
import pycolmap

__all__ = ["pycolmap"]
