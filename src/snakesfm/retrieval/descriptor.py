"""The interface of networks that sum up an image in one vector."""

import importlib
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor

Array = NDArray[Any]


class GlobalDescriptor(Protocol):
    """Describes images one by one; a new one joins by an entry in ``DESCRIPTORS``."""

    @property
    def size(self) -> int:
        """Length D of a descriptor."""

    @property
    def usual_side_px(self) -> int:
        """Longer side to which larger images are scaled down where the user says nothing."""

    @property
    def multiple(self) -> int:
        """Both sides of an image must be multiples of this."""

    def infer(self, images: Any) -> Any:
        """Descriptors (B,D) of images (B,3,H,W), float tensors in 0 .. 1, of any length."""


def describe_image(descriptor: GlobalDescriptor, rgb: Array, longer_side_px: int) -> Array:
    """The global descriptor of one image, whatever was described before.

    Parameters
    ----------
    descriptor : the network.
    rgb : (H,W,3) uint8.
    longer_side_px : larger images are scaled down to this; both sides become multiples, at least one.

    Returns
    -------
    (D,) float32 of unit length; zeros for an image of one tone, which resembles none.
    """
    import cv2

    if rgb.min() == rgb.max():
        return np.zeros(descriptor.size, np.float32)
    height, width = rgb.shape[:2]
    factor, step = min(1.0, longer_side_px / max(height, width)), descriptor.multiple
    columns, rows = (max(1, round(side * factor / step)) * step for side in (width, height))
    small = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    with load_torch().inference_mode():
        vector = to_array(descriptor.infer(to_tensor(small))[0], np.float64)
    length = float(np.linalg.norm(vector))
    unit: Array = (vector / max(length, 1e-12)).astype(np.float32)
    return unit


def _lazy(module: str, name: str) -> Callable[..., GlobalDescriptor]:
    """A descriptor whose libraries load when one is made."""

    def make(**options: Any) -> GlobalDescriptor:
        made: GlobalDescriptor = getattr(importlib.import_module(f"snakesfm.retrieval.{module}"), name)(
            **options
        )
        return made

    return make


DESCRIPTORS: dict[str, Callable[..., GlobalDescriptor]] = {
    "netvlad": _lazy("netvlad", "NetvladDescriptor"),
    "megaloc": _lazy("megaloc", "MegalocDescriptor"),
}


def create_descriptor(method: str, **options: Any) -> GlobalDescriptor:
    """The descriptor of a name in ``DESCRIPTORS``, with its weights as ``state``."""
    return DESCRIPTORS[method](**options)
