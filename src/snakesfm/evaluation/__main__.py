"""``python -m snakesfm.evaluation MODEL_FOLDER REFERENCE_FOLDER`` prints the metrics of a COLMAP model."""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.errors import SnakesfmError
from snakesfm.evaluation.colmap_model import model_poses, read_model
from snakesfm.evaluation.metrics import evaluate_poses, model_metrics
from snakesfm.grouping import offsets_of


def main(arguments: list[str] | None = None) -> int:
    """Evaluate one COLMAP model against another and print JSON; 1 where one of them cannot be read."""
    parser = argparse.ArgumentParser(prog="python -m snakesfm.evaluation", description=__doc__)
    parser.add_argument("model", type=Path, help="folder of a COLMAP model, binary or text")
    parser.add_argument("reference", type=Path, help="folder of the reference model")
    parser.add_argument("--per-image", action="store_true", help="also print the errors of every image")
    options = parser.parse_args(arguments)
    try:
        model, reference = read_model(options.model), read_model(options.reference)
    except SnakesfmError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    points = [model.points3D[key] for key in sorted(model.points3D)]
    lengths = [point.track.length() for point in points]
    registered = np.array([image.has_pose for image in model.images.values()], dtype=bool)
    errors = np.array([point.error for point in points], dtype=np.float64)
    defaults = EvaluateModelOptions().model_dump()
    evaluation = evaluate_poses(model_poses(model), model_poses(reference), **defaults)
    content: dict[str, object] = {
        **model_metrics(registered, offsets_of(lengths), errors),
        **evaluation.metrics,
    }
    if options.per_image:
        content["per_image"] = evaluation.per_image()
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
