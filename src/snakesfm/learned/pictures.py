"""Images as tensors."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from snakesfm.arrays import Array
from snakesfm.learned.device import choose_device, load_torch


def to_tensor(images: Sequence[Array]) -> Any:
    """Images of one shape as a batch on the chosen device.

    Parameters
    ----------
    images : B images, (H,W) or (H,W,3) uint8.

    Returns
    -------
    (B,1,H,W) or (B,3,H,W) float32 in 0 .. 1.
    """
    torch = load_torch()
    planes = [image[None] if image.ndim == 2 else image.transpose(2, 0, 1) for image in images]
    return torch.from_numpy(np.stack(planes)).to(choose_device()).float() / 255


def to_array(tensor: Any, dtype: Any) -> Array:
    """A tensor as an array of a dtype."""
    array: Array = tensor.detach().float().cpu().numpy().astype(dtype)
    return array
