"""Networks with their real weights on real photographs, from images to evaluated model, at a small size."""

from pathlib import Path

import pytest
from workflow_runner import Workflow

pytestmark = pytest.mark.e2e

# front-end, least AUC of relative poses at 1, 3 and 5 degrees
FRONT_ENDS = [
    ("aliked+lightglue", (80.0, 92.0, 95.0)),
    ("disk+lightglue", (80.0, 92.0, 95.0)),
    ("xfeat+lighterglue", (45.0, 75.0, 85.0)),
]


@pytest.mark.parametrize(("front_end", "least"), FRONT_ENDS)
def test_a_front_end_reconstructs_photographs(
    data: Path, weights: Path, workflow: Workflow, front_end: str, least: tuple
) -> None:
    folder = data / "strecha_entry_p10"
    metrics = workflow.metrics_of(
        folder,
        f"cameras={folder / 'reference'}",
        # each job with a network loads torch
        "blocks=1",
        f"front_end={front_end}",
        f"weights={weights}",
        "extract_features={max_shorter_side_px: 240, max_keypoints: 512}",
        "select_pairs={method: sequential, look_ahead: 3}",
        timeout=900,
    )
    assert metrics["reference_images_registered"] == 10
    for degrees, bound in zip((1, 3, 5), least, strict=True):
        assert bound <= metrics[f"relative_pose_auc_{degrees}deg"] < 99
    assert 0.1 < metrics["reprojection_error_px_mean"] < 2.5
    assert metrics["track_length_mean"] > 3.0
