from dataclasses import replace

import numpy as np
import pytest
from plain_artifacts import HEADER, write_plain_tracks
from synthetic_scene import write_scene

from snakesfm.artifacts import CameraCenters, CameraRotations, TrackTable, ViewGraph
from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.errors import SceneError
from snakesfm.stages.average_translations import run
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import make_problem


def write_inputs(folder, truth, rotations, kinds=None, labels=None):
    """The scene up to its tracks, with these averaged rotations, kinds of edges and labels of averaging."""
    inputs = write_scene(truth, folder)
    count = len(truth.pairs)
    none = np.zeros(count, int)
    graph = ViewGraph.read(inputs["graph"])
    # what the filter refused counts as averaging has it
    graph = replace(graph, labels=np.arange(count) % 2, kinds=none if kinds is None else kinds)
    graph.write(inputs["graph"], HEADER)
    CameraRotations(
        rotations=rotations,
        residuals_deg=np.zeros(count),
        labels=none if labels is None else labels,
        components=np.where(np.isfinite(rotations[:, 0, 0]), 0, -1),
    ).write(inputs["rotations"], HEADER)
    write_plain_tracks(inputs["tracks"], truth)
    return inputs


def stage_job(folder, inputs, **options):
    return StageJob(
        "average_translations",
        "scene",
        inputs,
        (folder / "centers.h5",),
        AverageTranslationsOptions(**options),
        seed=1,
    )


@pytest.mark.parametrize("method", ["scale_chain", "translation_recovery", "global_positioning"])
def test_stage_writes_centers_and_residuals(tmp_path, method):
    truth = make_problem(14, 700, "area", 0.4, 0.05, 0.3, 0.1, seed=2)
    rotations = truth.rotations.copy()
    rotations[5] = np.nan
    kinds = np.zeros(len(truth.pairs), np.int8)
    kinds[0] = 2
    labels = np.zeros(len(truth.pairs), np.int8)
    labels[1] = 1
    inputs = write_inputs(tmp_path, truth, rotations, kinds=kinds, labels=labels)
    run(stage_job(tmp_path, inputs, method=method))
    result = CameraCenters.read(tmp_path / "centers.h5")
    assert np.isnan(result.centers[5]).all()
    known = np.arange(14) != 5
    assert np.isfinite(result.centers[known]).all()
    a = result.centers[known] - result.centers[known].mean(axis=0)
    b = truth.centers[known] - truth.centers[known].mean(axis=0)
    found = np.linalg.norm(np.sum(a * b) / np.sum(a * a) * a - b, axis=1)
    assert 1e-5 < np.median(found) < 0.03
    off = (truth.pairs == 5).any(axis=1) | (kinds == 2) | (labels == 1)
    assert np.isnan(result.edge_residuals_deg[off]).all()
    assert np.isfinite(result.edge_residuals_deg[~off]).all()
    # all six wrong directions are more than 17 degrees off
    assert (result.edge_residuals_deg[truth.edge_outliers & ~off] < 5.0).mean() < 0.2
    assert (result.edge_residuals_deg[~off & ~truth.edge_outliers] < 5.0).mean() > 0.9
    assert np.median(result.ray_residuals_deg) < 0.15


def test_a_component_with_which_few_rays_agree_is_warned_of_by_itself(tmp_path, capsys):
    truth = make_problem(30, 2000, "area", 0.3, 0.05, seed=2)
    inputs = write_inputs(tmp_path, truth, truth.rotations)
    tracks = TrackTable.read(inputs["tracks"])
    wild = np.isin(tracks.image_ids, [3, 5, 8, 10])
    keypoints = np.where(
        wild[:, None], np.random.default_rng(0).uniform(0, 480, (len(wild), 2)), tracks.keypoints
    )
    replace(tracks, keypoints=keypoints.astype(np.float32)).write(inputs["tracks"], HEADER)
    averaged = CameraRotations.read(inputs["rotations"])
    components = (np.arange(30) < 12).astype(int)
    replace(averaged, components=components).write(inputs["rotations"], HEADER)
    run(stage_job(tmp_path, inputs, restarts=0))
    found = CameraCenters.read(tmp_path / "centers.h5").components
    placed = found >= 0
    assert placed[12:].all() and not placed[[3, 5, 8, 10]].any() and placed.sum() >= 24
    np.testing.assert_array_equal(found[placed], components[placed])
    said, count = capsys.readouterr(), placed.sum() - 18
    (warning,) = [line for line in said.err.splitlines() if "warning" in line]
    assert f"agree with the positions of {count} cameras" in warning
    assert (
        f"{placed.sum()} of 30 images with a rotation are positioned in frames of 18, {count} im"
        in said.out
    )


def test_two_images(tmp_path):
    truth = make_problem(2, 400, "facade", 0.2)
    run(stage_job(tmp_path, write_inputs(tmp_path, truth, truth.rotations)))
    centers = CameraCenters.read(tmp_path / "centers.h5").centers
    assert abs(np.linalg.norm(centers[1] - centers[0]) - 1.0) < 1e-9


def test_no_rotations_is_one_clear_sentence(tmp_path):
    truth = make_problem(5, 200, "ring")
    inputs = write_inputs(tmp_path, truth, np.full((5, 3, 3), np.nan))
    with pytest.raises(SceneError, match="no two images could be positioned"):
        run(stage_job(tmp_path, inputs))
