"""A cheap look at two images before they are matched: do their largest keypoints resemble each other?

Pre-emptive matching (Wu 2013, "Towards linear-time incremental structure from motion", section 3.1): of two
images that see the same, keypoints of large scale match too. Wu counts the matches of the ratio test; among
so few descriptors the second nearest is far off and strangers pass it as well, so here every pair of mutual
nearest neighbours counts by how much nearer it is than the second nearest.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.nearest import augmented, pop_two_largest

Array = NDArray[Any]


def largest_keypoints(points: KeypointSet, count: int) -> Array | None:
    """Descriptors (count,D) of the keypoints of largest scale, the earlier of equal ones first.

    None where the image has fewer than twice as many keypoints: then the look would save nothing.
    """
    if count == 0 or len(points) < 2 * count:
        return None
    return points.descriptors[np.argsort(-points.scales, kind="stable")[:count]]


def likeness(first: Array, second: Array) -> float:
    """How much two sets of descriptors (N,D) and (M,D) resemble each other, N and M at least two.

    The sum of (1 - r)^2 over all mutual nearest neighbours, where r is the distance over that to the second
    nearest. 400 keypoints of unrelated images give about 1.3, those of images that overlap 2 to 100.
    """
    block = augmented(first, norm_first=True) @ augmented(second, norm_first=False).T
    column_first = block.max(axis=0)
    nearest, best, runner_up = pop_two_largest(block)
    mutual = best == column_first[nearest]
    # rounding of float descriptors may lift the product of equal ones above zero
    best, runner_up = np.minimum(best[mutual], 0), np.minimum(runner_up[mutual], 0)
    ratios = np.sqrt(np.divide(best, runner_up, out=np.ones_like(best), where=runner_up < 0))
    return float(np.square(1 - ratios, dtype=np.float64).sum())
