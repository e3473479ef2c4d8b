"""Images as tensors."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.learned.device import choose_device, load_torch

Array = NDArray[Any]


def to_tensor(pixels: Array) -> Any:
    """An image (H,W) or (H,W,3) uint8 as (1,1,H,W) or (1,3,H,W) float32 in 0 .. 1, on the chosen device."""
    torch = load_torch()
    planes = pixels[None] if pixels.ndim == 2 else pixels.transpose(2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(planes[None])).to(choose_device()).float() / 255


def to_array(tensor: Any, dtype: Any) -> Array:
    """A tensor as an array of a dtype."""
    array: Array = tensor.detach().float().cpu().numpy().astype(dtype)
    return array
