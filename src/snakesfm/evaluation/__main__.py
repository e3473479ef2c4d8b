"""``python -m snakesfm.evaluation MODEL_FOLDER REFERENCE_FOLDER`` prints the metrics of a COLMAP model."""

import argparse
import json
import sys
from pathlib import Path

from snakesfm.errors import SnakesfmError
from snakesfm.evaluation.scores import score_model


def main(arguments: list[str] | None = None) -> int:
    """Evaluate one COLMAP model against another and print JSON; 1 where one of them cannot be read."""
    parser = argparse.ArgumentParser(prog="python -m snakesfm.evaluation", description=__doc__)
    parser.add_argument("model", type=Path, help="folder of a COLMAP model, binary or text")
    parser.add_argument("reference", type=Path, help="folder of the reference model")
    parser.add_argument("--per-image", action="store_true", help="also print the errors of every image")
    options = parser.parse_args(arguments)
    try:
        metrics, evaluation = score_model(options.model, options.reference)
    except SnakesfmError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    if evaluation.few_present:
        sys.stderr.write(f"warning: {evaluation.few_present}\n")
    content: dict[str, object] = dict(metrics)
    if options.per_image:
        content["per_image"] = evaluation.per_image()
    sys.stdout.write(json.dumps(content, indent=1, allow_nan=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
