"""pycolmap, loaded after cv2: in the other order their PNG libraries clash.

All code takes it from here: ``from snakesfm.geometry.colmap_binding import pycolmap``. The two take a tenth
of a second to load, so modules that jobs import without need of them do so inside functions.
"""

import contextlib
import signal

import cv2  # noqa: F401

_ended_by = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

# glog's handler, which comes with it, prints the stack of a process that is told to end, and may then wait
# for a lock for ever; in another thread than the first, Python leaves handlers as they are
with contextlib.suppress(ValueError):
    signal.signal(signal.SIGTERM, _ended_by)

__all__ = ["pycolmap"]
