"""gtsam's TranslationRecovery and MFAS."""

from typing import Any

import gtsam
import numpy as np

from snakesfm.arrays import Array
from snakesfm.translation_averaging.problem import PositioningProblem

HUBER_SIGMAS = 1.345


def recover_translations(problem: PositioningProblem, sigma: float, seed: int) -> Array:
    """Centres (N,3), landmarks being further unknowns; NaN for images without edges or rays.

    ``sigma`` is that of the chordal residual of a direction.
    """
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS), gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    )
    measurements = _measurements(problem, noise)
    rows = zip(problem.ray_images.tolist(), problem.ray_tracks.tolist(), problem.rays, strict=True)
    measurements += [
        gtsam.BinaryMeasurementUnit3(image, problem.image_count + track, gtsam.Unit3(ray), noise)
        for image, track, ray in rows
    ]
    centers = np.full((problem.image_count, 3), np.nan)
    if measurements:
        # gtsam's own random start goes on from call to call, so a second call would differ.
        rng = np.random.default_rng(seed)
        start = gtsam.Values()
        landmarks = problem.image_count + np.unique(problem.ray_tracks)
        for key in np.concatenate([problem.images(), landmarks]).tolist():
            start.insert(key, rng.uniform(-1.0, 1.0, 3))
        solver = gtsam.TranslationRecovery(gtsam.LevenbergMarquardtParams())
        values = solver.run(measurements, 1.0, initialValues=start)
        for image in problem.images().tolist():
            if values.exists(image):
                centers[image] = values.atPoint3(image)
    return centers


def mfas_weights(problem: PositioningProblem, projections: int, seed: int) -> Array:
    """Average outlier weight (E) of the edges over 1D projections (1DSfM, section 4): 0 good, 1 bad.

    The projections are drawn among the edges' own directions.
    """
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    measurements = _measurements(problem, noise)
    rng = np.random.default_rng(seed)
    count = min(projections, len(problem.directions))
    chosen = rng.choice(len(problem.directions), count, replace=False)
    rows = {(int(i), int(j)): row for row, (i, j) in enumerate(problem.pairs)}
    totals = np.zeros(len(problem.pairs))
    for k in chosen:
        weights = gtsam.MFAS(measurements, gtsam.Unit3(problem.directions[k])).computeOutlierWeights()
        for (i, j), weight in weights.items():
            totals[rows[(i, j)] if (i, j) in rows else rows[(j, i)]] += abs(weight)
    return totals / max(count, 1)


def _measurements(problem: PositioningProblem, noise: Any) -> list[Any]:
    edges = zip(problem.pairs.tolist(), problem.directions, strict=True)
    return [gtsam.BinaryMeasurementUnit3(i, j, gtsam.Unit3(d), noise) for (i, j), d in edges]
