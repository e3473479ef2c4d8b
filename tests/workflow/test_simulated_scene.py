"""The workflow from simulated artifacts on, without an image."""

import json
from pathlib import Path

import pytest
from workflow_runner import Workflow

from snakesfm.simulate import Simulation, SimulationOptions

pytestmark = pytest.mark.workflow


def test_the_workflow_goes_on_from_simulated_matches_to_an_accurate_model(
    workflow: Workflow, tmp_path: Path
) -> None:
    folder = tmp_path / "field"
    options = SimulationOptions(images=60, until="match_pairs", partners=6, keypoints=1200, blocks=2)
    Simulation(folder, options).run()
    outcome = workflow.run("--configfile", str(folder / "config.yaml"), timeout=900)
    assert outcome.status == 0, outcome.text
    # what was simulated is taken as it is
    assert {"index_images", "extract_features", "select_pairs", "match_pairs"}.isdisjoint(outcome.rules)
    assert outcome.rules.count("estimate_two_view") == 3
    metrics = json.loads((folder / "results" / "field" / "evaluate_model" / "metrics.json").read_text())
    assert metrics["registered_images"] == 60
    assert 95.0 < metrics["relative_pose_auc_1deg"] < 99.9
    # the keypoints err by half a pixel
    assert 0.35 < metrics["reprojection_error_px_mean"] < 0.75
    assert 0.0 < metrics["position_error_percent_median"] < 0.3
    again = workflow.run("--configfile", str(folder / "config.yaml"))
    assert again.status == 0 and again.rules == []
