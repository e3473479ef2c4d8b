"""evaluate_model: the metrics of the largest model, against a reference where there is one."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from snakesfm.artifacts import ImageIndex, Reconstruction, write_json
from snakesfm.atomic import atomic_path
from snakesfm.evaluation.metrics import Poses, evaluate_poses, model_metrics
from snakesfm.stages.job import StageJob

if TYPE_CHECKING:
    from snakesfm.config.evaluate_model import EvaluateModelOptions


def run(job: StageJob) -> None:
    """Write metrics.json and, where it is among the outputs, its scalars as one row of metrics.csv."""
    index = ImageIndex.read(job.path("index"))
    adjusted = Reconstruction.read(job.path("reconstruction"))
    model = adjusted.select_model(0)
    poses = Poses([str(name) for name in index.names], model.rotations, model.translations)
    row: dict[str, Any] = {"scene": job.scene}
    row |= model_metrics(poses.registered, model.offsets, model.errors_px)
    row["images_in_other_models"] = int(np.count_nonzero(adjusted.models > 0))
    content: dict[str, Any] = dict(row)
    reference = str(job.settings.get("reference") or "")
    if reference:
        from snakesfm.evaluation.colmap_model import model_poses, read_model

        options: EvaluateModelOptions = job.options
        known = model_poses(read_model(Path(reference).expanduser()))
        evaluation = evaluate_poses(poses, known, **options.model_dump())
        if evaluation.few_present:
            job.warn(evaluation.few_present)
        row |= evaluation.metrics
        content = {**row, "reference": reference, "per_image": evaluation.per_image()}
    for path in job.outputs:
        if path.suffix == ".csv":
            _write_csv(path, row)
    write_json(job.output, content)


def _write_csv(path: Path, row: dict[str, Any]) -> None:
    import csv

    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(row)
        writer.writerow("" if value is None else value for value in row.values())
