"""pycolmap, loaded after cv2: in the other order their PNG libraries clash.

The two take a tenth of a second to load, so this module is imported inside the functions that need it:
``from snakesfm.geometry.colmap_binding import pycolmap``.
"""

import cv2  # noqa: F401
import pycolmap

__all__ = ["pycolmap"]
