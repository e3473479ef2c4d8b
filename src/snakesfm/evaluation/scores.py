"""How good a COLMAP model on disk is, whichever tool wrote it."""

from pathlib import Path

import numpy as np

from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.evaluation.colmap_model import model_poses, read_model
from snakesfm.evaluation.metrics import Metrics, PoseEvaluation, evaluate_poses, model_metrics
from snakesfm.geometry.colmap_binding import pycolmap
from snakesfm.grouping import offsets_of

# larger errors are what pycolmap has for points behind a camera
FARTHEST_PX = 1e9


def score_model(folder: Path, reference: Path) -> tuple[Metrics, PoseEvaluation]:
    """All metrics of the model in a folder, and how its poses compare with those of a reference model.

    Thresholds are the defaults of evaluate_model. Reprojection errors are computed anew: tools define those
    that they store in different ways, and store -1 where they computed none. Observations of points behind
    their cameras have none; they are counted.

    Raises
    ------
    ConfigError : one of the models cannot be read.
    """
    model, truth = read_model(folder), model_poses(read_model(reference))
    model.update_point_3d_errors()
    points = [model.points3D[key] for key in sorted(model.points3D)]
    offsets = offsets_of([point.track.length() for point in points])
    errors_px = np.array([point.error for point in points], dtype=np.float64)
    lengths = np.diff(offsets)
    measured = lengths.copy()
    for row in np.flatnonzero(~(errors_px < FARTHEST_PX)).tolist():
        errors_px[row], measured[row] = _error_ahead(model, points[row])
    registered = np.array([image.has_pose for image in model.images.values()], dtype=bool)
    metrics = model_metrics(registered, offsets, errors_px, measured)
    metrics["observations_behind_camera"] = int(np.sum(lengths - measured))
    evaluation = evaluate_poses(model_poses(model), truth, **EvaluateModelOptions().model_dump())
    return {**metrics, **evaluation.metrics}, evaluation


def _error_ahead(model: pycolmap.Reconstruction, point: pycolmap.Point3D) -> tuple[float, int]:
    """Mean reprojection error of a point in pixels over images that it is ahead of, and their number."""
    errors = []
    for element in point.track.elements:
        image = model.image(element.image_id)
        pixel = image.project_point(point.xyz)
        if pixel is not None:
            errors.append(float(np.linalg.norm(pixel - image.point2D(element.point2D_idx).xy)))
    return (float(np.mean(errors)) if errors else 0.0), len(errors)
