"""The interface of networks that summarise an image in one vector."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from snakesfm.arrays import Array
from snakesfm.lazy_loading import lazy
from snakesfm.learned.batches import equal_rows
from snakesfm.learned.device import load_torch
from snakesfm.learned.pictures import to_array, to_tensor
from snakesfm.retrieval.rounding import round_units


class GlobalDescriptor(Protocol):
    """Describes images; a new one joins by an entry in ``DESCRIPTORS``."""

    @property
    def size(self) -> int:
        """Length D of a descriptor."""

    @property
    def usual_side_px(self) -> int:
        """Longer side to which larger images are scaled down where the user says nothing."""

    @property
    def multiple(self) -> int:
        """Both sides of an image must be multiples of this."""

    @property
    def smallest_side_px(self) -> int:
        """Shorter side below which long images are not scaled down: the network needs it."""

    def infer(self, images: Any) -> Any:
        """Descriptors (B,D) of images (B,3,H,W), float tensors in 0 .. 1, of any length."""


def describe_batch(descriptor: GlobalDescriptor, images: Sequence[Array], longer_side_px: int) -> Array:
    """The global descriptors of images, each to rounding what it is alone.

    Parameters
    ----------
    descriptor : the network.
    images : B images, (H,W,3) uint8 of any sizes; those that become one size share their work.
    longer_side_px : larger images are scaled down to this, but for those that would become too narrow;
        both sides become multiples, at least one.

    Returns
    -------
    (B,D) float32 of unit length up to rounding to multiples of 1/2048; zeros for an image of one tone,
    which resembles none.
    """
    vectors = np.zeros((len(images), descriptor.size))
    small = [_shrink(rgb, longer_side_px, descriptor) for rgb in images]
    for same in equal_rows([rgb.shape for rgb in small]):
        rows = [row for row in same if images[row].min() != images[row].max()]
        if rows:
            with load_torch().inference_mode():
                inferred = descriptor.infer(to_tensor([small[row] for row in rows]))
            vectors[rows] = to_array(inferred, np.float64)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return round_units(vectors / np.maximum(lengths, 1e-12))


def _shrink(rgb: Array, longer_side_px: int, descriptor: GlobalDescriptor) -> Array:
    """Scale an image down to a longer side, not too narrow, and both sides to the nearest multiples."""
    import cv2

    height, width = rgb.shape[:2]
    multiple, least = descriptor.multiple, descriptor.smallest_side_px
    factor = min(1.0, max(longer_side_px / max(height, width), least / min(height, width)))
    columns, rows = (
        max(least, max(1, round(side * factor / multiple)) * multiple) for side in (width, height)
    )
    small: Array = cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA)
    return small


DESCRIPTORS: dict[str, Callable[..., GlobalDescriptor]] = {
    "netvlad": lazy("retrieval.netvlad", "NetvladDescriptor"),
    "megaloc": lazy("retrieval.megaloc", "MegalocDescriptor"),
}
