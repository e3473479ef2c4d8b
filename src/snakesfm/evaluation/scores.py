"""How good a COLMAP model on disk is, whichever tool wrote it."""

from pathlib import Path

import numpy as np

from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.evaluation.colmap_model import model_poses, read_model
from snakesfm.evaluation.metrics import Metrics, PoseEvaluation, evaluate_poses, model_metrics
from snakesfm.grouping import offsets_of


def score_model(folder: Path, reference: Path) -> tuple[Metrics, PoseEvaluation]:
    """All metrics of the model in a folder, and how its poses compare with those of a reference model.

    Thresholds are the defaults of evaluate_model. Reprojection errors are computed anew: tools define those
    that they store in different ways, and store -1 where they computed none.

    Raises
    ------
    ConfigError : one of the models cannot be read.
    """
    model, truth = read_model(folder), model_poses(read_model(reference))
    model.update_point_3d_errors()
    points = [model.points3D[key] for key in sorted(model.points3D)]
    offsets = offsets_of([point.track.length() for point in points])
    errors_px = np.array([point.error for point in points], dtype=np.float64)
    registered = np.array([image.has_pose for image in model.images.values()], dtype=bool)
    evaluation = evaluate_poses(model_poses(model), truth, **EvaluateModelOptions().model_dump())
    return {**model_metrics(registered, offsets, errors_px), **evaluation.metrics}, evaluation
