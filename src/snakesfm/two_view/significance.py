"""Significance of a relative pose: how unlikely it is that as many matches agree with it by chance."""

import numpy as np

from snakesfm.arrays import Array

LOG10 = float(np.log(10.0))
# smaller distances count as this, for keypoints are no points
FLOOR_PX = 0.25


def significance_of(errors_px: Array, width_px: float, height_px: float) -> float:
    """Minus log10 of the number of false alarms of a relative pose; larger is more significant.

    Parameters
    ----------
    errors_px : (M,) distances of all matches to their epipolar lines, inliers and outliers.
    width_px, height_px : extent of the area over which the matched keypoints lie.

    The number of matches that agree is the one for which chance is least likely, so no threshold is needed.
    Source: Moisan and Stival, A probabilistic criterion to detect rigid point matches, IJCV 2004;
    Moulon et al., Adaptive structure from motion with a contrario model estimation, ACCV 2012.
    """
    count = len(errors_px)
    sample = 5
    if count <= sample:
        return 0.0
    ordered = np.sort(np.maximum(np.abs(errors_px), FLOOR_PX))[sample:]
    agreeing = np.arange(sample + 1, count + 1)
    log_factorials = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, count + 1)))])
    log_samples = log_factorials[agreeing] - log_factorials[sample] - log_factorials[agreeing - sample]
    log_subsets = log_factorials[count] - log_factorials[agreeing] - log_factorials[count - agreeing]
    chance = _chance_within(ordered, width_px, height_px)
    log_alarms = np.log(count - sample) + log_subsets + log_samples + (agreeing - sample) * np.log(chance)
    return max(0.0, -float(log_alarms.min()) / LOG10)


def expected_by_chance(errors_px: Array, width_px: float, height_px: float, max_error_px: float) -> float:
    """How many mismatches are expected within ``max_error_px`` of their epipolar lines.

    Parameters
    ----------
    errors_px : (M,) signed distances of all matches to their epipolar lines; those beyond the limit are
        taken for mismatches.
    width_px, height_px : extent of the area over which the matched keypoints lie.
    """
    mismatches = np.count_nonzero(np.abs(errors_px) >= max_error_px)
    return float(mismatches * _chance_within(np.array(max_error_px), width_px, height_px))


def _chance_within(distances_px: Array, width_px: float, height_px: float) -> Array:
    """The probabilities that a point anywhere in an area lies no farther from a line across it."""
    area = max(width_px * height_px, 1.0)
    chance: Array = np.minimum(1.0, 2.0 * distances_px * np.hypot(width_px, height_px) / area)
    return chance
