"""A quick model of a scene, made for what its bundle adjustment says of the cameras."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from snakesfm.artifacts.base import temporary_folder
from snakesfm.artifacts.images import CalibratedCameras
from snakesfm.artifacts.mapping import Reconstruction
from snakesfm.artifacts.pairs import PairMatches
from snakesfm.stages.job import StageJob

# of each stage the inputs beside index and features, and the name that its output has in the next ones
STEPS = {
    "estimate_two_view": (("cameras", "matches"), "geometries"),
    "build_view_graph": (("geometries",), "graph"),
    "filter_view_graph": (("graph",), "graph"),
    "average_rotations": (("graph",), "rotations"),
    "build_tracks": (("geometries", "graph", "rotations"), "tracks"),
    "average_translations": (("cameras", "graph", "rotations", "tracks"), "centers"),
    "triangulate_tracks": (("cameras", "rotations", "centers", "tracks"), "points"),
    "adjust_bundle": (
        ("cameras", "geometries", "graph", "rotations", "centers", "points"),
        "reconstruction",
    ),
}
# focal lengths to a few per cent need neither all observations nor the last digit
QUICK_ADJUSTMENT = {
    "thresholds_px": (10.0, 5.0),
    "complete_tracks": False,
    "register_images": False,
    "refine_keypoints": False,
    "refine_principal_points": False,
    "function_tolerance": 3e-4,
}


def make_provisional_model(
    job: StageJob, cameras: CalibratedCameras, matches: Sequence[PairMatches]
) -> Reconstruction:
    """The model that the stages from estimate_two_view to adjust_bundle make of some pairs.

    They have their default options, so that it does not depend on those for the model itself. Distortion
    is refined where it is in the model, as it would stay otherwise.

    Parameters
    ----------
    job : its ``index`` and ``features`` are used, and its settings and seed.
    cameras : where intrinsics start.
    matches : the pairs, in parts that are worked on side by side.

    Raises
    ------
    SceneError : they give no model.
    """
    with temporary_folder(job.output.parent) as folder:
        files: dict[str, Any] = {name: job.inputs[name] for name in ("index", "features")}
        files["cameras"] = Path(folder, "cameras.h5")
        cameras.write(files["cameras"], job.header)
        with ThreadPoolExecutor(max(1, len(matches))) as pool:
            steps = []
            for number, part in enumerate(matches):
                files["matches"] = Path(folder, f"matches_{number}.h5")
                part.write(files["matches"], job.header)
                steps.append(_step(job, "estimate_two_view", files, Path(folder, f"{number}.h5")))
            list(pool.map(_run, steps))
        files["geometries"] = [step.output for step in steps]
        for stage, (_, output) in list(STEPS.items())[1:]:
            step = _step(job, stage, files, Path(folder, f"{stage}.h5"))
            _run(step)
            files[output] = step.output
        return Reconstruction.read(files["reconstruction"])


def _step(job: StageJob, stage: str, files: dict[str, Any], output: Path) -> StageJob:
    """The job of a stage on some files."""
    # jobs are spared what checks options, unless they need it
    from snakesfm.config.configuration import options_class

    changes: dict[str, Any] = {}
    if stage == "adjust_bundle":
        distorts = job.settings.get("refine_distortion", True)
        changes = {**QUICK_ADJUSTMENT, "refine_distortion": distorts}
    names = ("index", "features", *STEPS[stage][0])
    return replace(
        job,
        stage=stage,
        inputs={name: files[name] for name in names},
        outputs=(output,),
        options=options_class(stage)(**changes).resolved(),
        former=None,
        terminal=None,
    )


def _run(step: StageJob) -> None:
    import_module(f"snakesfm.stages.{step.stage}").run(step)
