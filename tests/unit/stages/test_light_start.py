"""What a job loads before it works: a small scene's time is mostly the start-up of its jobs."""

import json
import pickle
import subprocess
import sys

import pytest

from snakesfm.config.configuration import options_class
from snakesfm.pipeline import STAGES
from snakesfm.stages.job import JobOptions

HEAVY = (
    "pydantic",
    "scipy",
    "pycolmap",
    "cv2",
    "gtsam",
    "poselib",
    "pandas",
    "PIL",
    "jinja2",
    "plotly",
    "torch",
)
NEEDED = {
    "extract_features": {"cv2", "PIL"},
    "merge_keypoints": {"cv2", "PIL"},
    "index_images": {"cv2", "pycolmap", "PIL"},
    "estimate_two_view": {"cv2", "poselib"},
    "adjust_bundle": {"cv2", "pycolmap", "poselib"},
    "export_model": {"cv2", "pycolmap"},
    "render_report": {"cv2"},
}


def loaded_by(statement: str) -> set[str]:
    """Which of the heavy packages a fresh interpreter holds after a statement."""
    code = f"{statement}\nimport json, sys\nprint(json.dumps(sorted(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    return set(json.loads(out)) & set(HEAVY)


@pytest.mark.parametrize("stage", STAGES)
def test_a_job_loads_only_what_its_stage_needs(stage: str) -> None:
    assert loaded_by(f"import snakesfm.job, snakesfm.stages.{stage}") <= NEEDED.get(stage, set())


def test_colmap_binding_loads_cv2_first() -> None:
    code = "import snakesfm.geometry.colmap_binding, sys; names = list(sys.modules)\n"
    code += "assert names.index('cv2') < names.index('pycolmap')"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("stage", STAGES)
def test_job_options_are_those_of_the_model(stage: str) -> None:
    model = options_class(stage)()
    options = JobOptions(json.loads(model.canonical_json()), model.stage_version)
    assert options.canonical_json() == model.canonical_json()
    assert options.stage_version == model.stage_version
    assert options.model_dump() == model.model_dump()
    for name in type(model).model_fields:
        assert getattr(options, name) == getattr(model, name)
    assert pickle.loads(pickle.dumps(options)).canonical_json() == model.canonical_json()


def test_job_options_are_read_only() -> None:
    options = JobOptions({"method": "listed"}, 1)
    with pytest.raises(AttributeError):
        options.method = "exhaustive"
