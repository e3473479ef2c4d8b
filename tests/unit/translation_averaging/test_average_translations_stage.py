from dataclasses import replace

import numpy as np
import pytest

from snakesfm.artifacts import (
    CalibratedCameras,
    CameraCenters,
    CameraRotations,
    ImageIndex,
    TrackTable,
    ViewGraph,
)
from snakesfm.artifacts.base import Header
from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import cameras_to_columns
from snakesfm.stages.average_translations import run
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import make_problem

HEADER = Header("test", 1, "scene")


def write_inputs(folder, truth, rotations, kinds=None, labels=None):
    count, edges = truth.image_count, len(truth.pairs)
    models, sizes, params, sources = cameras_to_columns(truth.cameras)
    index = ImageIndex(
        names=[f"{i:03d}.jpg" for i in range(count)],
        sizes=np.tile(sizes[0], (count, 1)),
        sha256=["0"] * count,
        blocks=np.zeros(count, np.int32),
        camera_ids=truth.camera_ids,
        orientations=np.ones(count, np.int32),
        focal_exif_px=np.full(count, np.nan),
        gps=np.full((count, 3), np.nan),
        duplicate_of=np.full(count, -1, np.int32),
        camera_models=models,
        camera_sizes=sizes,
        camera_params=params,
        camera_sources=sources,
        refused_names=[],
        refused_reasons=[],
        warnings=[],
    )
    cameras = CalibratedCameras(
        models=models,
        sizes=sizes,
        params=params,
        sources=sources,
        focal_sigma=np.zeros(1),
        pair_counts=np.zeros(1, np.int32),
        overlay_cells=np.zeros((0, 4), np.int32),
        warnings=np.zeros(0, dtype=object),
    )
    graph = ViewGraph(
        pairs=truth.pairs,
        rotations=truth.edge_rotations,
        translations=truth.edge_translations,
        covariances=truth.edge_covariances,
        kinds=np.zeros(edges, np.int8) if kinds is None else kinds,
        inlier_counts=truth.edge_inlier_counts,
        triangulation_angles_deg=truth.edge_angles_deg,
        # what the filter refused counts as averaging has it
        labels=np.arange(edges) % 2,
        cycle_min_deg=np.zeros(edges),
        cycle_median_deg=np.zeros(edges),
        components=np.zeros(count, np.int32),
    )
    averaged = CameraRotations(
        rotations=rotations,
        residuals_deg=np.zeros(edges),
        labels=np.zeros(edges, np.int8) if labels is None else labels,
        components=np.where(np.isfinite(rotations[:, 0, 0]), 0, -1),
    )
    tracks = TrackTable(
        offsets=truth.track_offsets,
        image_ids=truth.track_image_ids,
        keypoint_ids=truth.track_keypoint_ids,
        part_ids=np.repeat(np.arange(len(truth.track_offsets) - 1), np.diff(truth.track_offsets)),
        keypoints=truth.track_keypoints,
        colors=np.zeros((len(truth.track_image_ids), 3), np.uint8),
        lengths_unmerged=np.zeros(0, np.int64),
        lengths_merged=np.zeros(0, np.int64),
    )
    inputs = {}
    for name, artifact in dict(
        index=index, cameras=cameras, graph=graph, rotations=averaged, tracks=tracks
    ).items():
        inputs[name] = folder / f"{name}.h5"
        artifact.write(inputs[name], HEADER)
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
    inputs = write_inputs(tmp_path, truth, rotations, kinds, labels)
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


def test_default_is_identical_twice(tmp_path):
    truth = make_problem(10, 500, "ring", 0.4, 0.05)
    inputs = write_inputs(tmp_path, truth, truth.rotations)
    run(stage_job(tmp_path, inputs))
    first = (tmp_path / "centers.h5").read_bytes()
    run(stage_job(tmp_path, inputs))
    assert (tmp_path / "centers.h5").read_bytes() == first


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
