"""Steps in the altitudes of EXIF, as of barometers that start anew with every battery or flight."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter
from scipy.special import fdtrc

from snakesfm.arrays import Array
from snakesfm.geometry.robust import robust_sigma

# smaller ones do little harm
LEAST_STEP_M = 3.0
# of a step found by chance, at any of the places where there could be one
MOST_PROBABILITY = 0.05
MOST_STEPS = 40
# images on either side of a step that must show it: enough of them, and not so many that drift counts
LEAST_SIDE = 5
SIDE = 15
# of a step, what these must show beside a steady drift
LEAST_JUMP = 0.5
# of how far altitudes jump elsewhere: noise that wanders looks like steps, none of which stands out
LEAST_JUMP_SIGMAS = 6.0
# of how far images differ from their neighbours, and in metres: what one errs by alone
OUTLIER_SIGMAS = 5.0
OUTLIER_M = 10.0
# images between knots of a drift, and how many knots at most
KNOT_IMAGES = 30
MOST_KNOTS = 100
# parts of a flight of which each errs on its own, from which the uncertainty of a slope is estimated
LEAST_PARTS = 12
# of the search for altitudes that no step or drift explains
TRIMS = 3
TRIM_SIGMAS = 4.0
# of its standard deviations, by which a slope must be nearer to one than to another
SURE_SIGMAS = 2.5


def altitude_steps(centers: Array, altitudes: Array) -> list[tuple[int, float]]:
    """Images from which on altitudes are too high, and by how many metres, negative where too low.

    A model that steps have tilted deviates from altitudes by a plane too, and barometers drift; so a plane,
    a drift and the steps are estimated together.

    Parameters
    ----------
    centers : (n,3) camera centres in metres, the third upwards but for a tilt, in the order in which the
        images were taken.
    altitudes : (n,) metres in EXIF.
    """
    rows = np.flatnonzero(_has_like(altitudes - centers[:, 2]))
    if len(rows) < 4 * LEAST_SIDE:
        return []
    deviations = altitudes[rows] - centers[rows, 2]
    time = np.linspace(-1.0, 1.0, len(rows))
    horizontal = centers[rows, :2] - centers[rows, :2].mean(axis=0)
    smooth = np.column_stack([np.ones(len(rows)), horizontal, time, time**2])
    steps: list[int] = []
    while len(steps) < MOST_STEPS:
        place, probability = _most_probable(_with_steps(smooth, steps), deviations)
        if probability > MOST_PROBABILITY:
            break
        steps = sorted([*steps, place])
    while steps:
        design = _with_steps(smooth, steps)
        solution = np.linalg.lstsq(design, deviations)[0]
        heights = solution[smooth.shape[1] :]
        flat = deviations - smooth @ solution[: smooth.shape[1]]
        jumps = np.array([_jump(flat, place, steps) for place in steps])
        least = max(LEAST_STEP_M, LEAST_JUMP_SIGMAS * _usual_jump(deviations - design @ solution))
        shown = jumps * np.sign(heights) >= np.maximum(least, LEAST_JUMP * np.abs(heights))
        doubtful = np.flatnonzero(~shown | (np.abs(heights) < least))
        if not len(doubtful):
            # where a step was missed, least squares bend the heights of the others
            return [(int(rows[place]), float(jump)) for place, jump in zip(steps, jumps, strict=True)]
        del steps[doubtful[np.argmin(np.abs(heights[doubtful]))]]
    return []


def is_more_level(centers: Array, altitudes: Array, places: Sequence[int], slope: Array) -> bool:
    """Whether a model is surely less tilted once it has been turned by a slope.

    To a flight to and fro, steps and a tilt across its lines look alike, but from one line to the next
    a tilt shows at once and a drift does not. So the tilt is estimated beside a drift that may bend every
    few images and steps of any height.

    Parameters
    ----------
    centers, altitudes : as of :func:`altitude_steps`.
    places : images at which altitudes step.
    slope : (2,) metres that the turned model is higher per metre along the first and the second axis.
    """
    nearer, sigma = _nearness(centers, altitudes, slope, places)
    # where a bent model looks like steps, their columns hide the lines that speak against them
    return nearer > SURE_SIGMAS * sigma and _nearness(centers, altitudes, slope, [])[0] > 0.0


def _nearness(centers: Array, altitudes: Array, slope: Array, places: Sequence[int]) -> tuple[float, float]:
    """How much nearer the tilt beside a drift and steps is to a slope than to none, and how sure that is.

    The first is positive where it is nearer, the second its standard deviation.
    """
    deviations = altitudes - centers[:, 2]
    columns = _with_steps(_bending(len(centers)), places)
    rows = np.flatnonzero(_has_like(deviations))
    for _ in range(TRIMS):
        # of columns that are alike once images are left out, only what they span
        basis, sizes, _ = np.linalg.svd(columns[rows], full_matrices=False)
        basis = basis[:, sizes > 1e-9 * sizes[0]]
        left = np.column_stack([centers[rows, :2], deviations[rows]])
        left -= basis @ (basis.T @ left)
        found = np.linalg.lstsq(left[:, :2], left[:, 2])[0]
        residuals = left[:, 2] - left[:, :2] @ found
        kept = np.abs(residuals) <= TRIM_SIGMAS * robust_sigma(residuals, 1e-6)
        if kept.all():
            break
        rows = rows[kept]
    # from the middle between the two
    nearer = float((found - slope / 2.0) @ slope)
    shares = residuals * (np.linalg.pinv(left[:, :2]).T @ slope)
    parts = np.array_split(shares, max(LEAST_PARTS, len(shares) // KNOT_IMAGES))
    return nearer, float(np.sqrt(sum(part.sum() ** 2 for part in parts)))


def _bending(count: int) -> Array:
    """Columns (count,c) whose sums are the drifts that bend at knots only."""
    knots = np.linspace(0, count - 1, 2 + min(count // KNOT_IMAGES, MOST_KNOTS))
    spacing = knots[1] - knots[0]
    bending: Array = np.maximum(1.0 - np.abs(np.arange(count)[:, None] - knots) / spacing, 0.0)
    return bending


def _has_like(deviations: Array) -> Array:
    """Which images deviate as those before or those after them do (n,) bool."""
    medians = median_filter(deviations, LEAST_SIDE, mode="nearest")
    shift = LEAST_SIDE // 2 + 1
    before = np.concatenate([np.repeat(medians[:1], shift), medians[:-shift]])
    after = np.concatenate([medians[shift:], np.repeat(medians[-1:], shift)])
    alone = np.minimum(np.abs(deviations - before), np.abs(deviations - after))
    like: Array = alone <= OUTLIER_SIGMAS * robust_sigma(alone, OUTLIER_M / OUTLIER_SIGMAS)
    return like


def _with_steps(smooth: Array, steps: Sequence[int]) -> Array:
    """Columns that vary smoothly (n,c) and one for each step, 1 from its image on."""
    after = np.arange(len(smooth))[:, None] >= np.array(steps, np.int64)
    return np.column_stack([smooth, after.astype(np.float64)])


def _most_probable(design: Array, deviations: Array) -> tuple[int, float]:
    """The place of the one more step that explains most, and how probable it is by chance at any place."""
    basis = np.linalg.qr(design)[0]
    left = deviations - basis @ (basis.T @ deviations)
    # of a step at each image: its product with what is left, and the part of it that is not in the basis
    products = np.cumsum(left[::-1])[::-1]
    lengths = np.arange(len(left), 0, -1.0)
    free = lengths - (np.cumsum(basis[::-1], axis=0)[::-1] ** 2).sum(axis=1)
    gains = np.where(free > 1e-6 * lengths, products**2 / np.maximum(free, 1e-12), 0.0)
    gains[:LEAST_SIDE] = gains[len(gains) - LEAST_SIDE + 1 :] = 0.0
    place = int(np.argmax(gains))
    freedom = len(left) - design.shape[1] - 1
    rest = max(float(left @ left) - float(gains[place]), 1e-12)
    return place, len(left) * float(fdtrc(1, freedom, gains[place] / rest * freedom))


def _jump(deviations: Array, place: int, steps: Sequence[int]) -> float:
    """How far deviations jump at an image, by those near it; 0 where another step leaves too few."""
    start = max([0, place - SIDE, *(step for step in steps if step < place)])
    end = min([len(deviations), place + SIDE, *(step for step in steps if step > place)])
    if min(place - start, end - place) < LEAST_SIDE:
        return 0.0
    return float(_jump_weights(place - start, end - place) @ deviations[start:end])


def _usual_jump(deviations: Array) -> float:
    """The robust standard deviation of the jumps at all images."""
    side = min(SIDE, len(deviations) // 4)
    return robust_sigma(sliding_window_view(deviations, 2 * side) @ _jump_weights(side, side), 0.0)


def _jump_weights(before: int, after: int) -> Array:
    """By which the sum of deviations is the jump between them, beside a steady drift, by least squares."""
    rows = np.arange(-before, after)
    weights: Array = np.linalg.pinv(np.column_stack([np.ones(len(rows)), rows, rows >= 0]))[2]
    return weights
