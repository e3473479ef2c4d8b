"""Keypoints at one place of one image, which a detector gives once per orientation."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def canonical_keypoints(keypoints: Array) -> Array:
    """The first keypoint of an image at the same place.

    Parameters
    ----------
    keypoints : (K,2) float32, pixels of one image.

    Returns
    -------
    (K,) int64: for each keypoint the lowest row with exactly its position; SIFT describes one place once
    per dominant orientation, and a track must count such a place as one observation.
    """
    if len(keypoints) == 0:
        return np.zeros(0, dtype=np.int64)
    order = np.lexsort((keypoints[:, 1], keypoints[:, 0]))
    ordered = keypoints[order]
    fresh = np.r_[True, np.any(ordered[1:] != ordered[:-1], axis=1)]
    first = order[np.nonzero(fresh)[0]][np.cumsum(fresh) - 1]
    canonical = np.empty(len(keypoints), dtype=np.int64)
    canonical[order] = first
    return canonical
