"""build_view_graph, filter_view_graph and average_rotations run on small artifacts."""

import numpy as np
import pytest
from plain_artifacts import write_plain_index
from scipy.spatial.transform import Rotation

from snakesfm.artifacts.mapping import CameraRotations
from snakesfm.artifacts.pairs import EDGE_LABELS, TwoViewGeometries, ViewGraph
from snakesfm.config.average_rotations import AverageRotationsOptions
from snakesfm.config.build_view_graph import BuildViewGraphOptions
from snakesfm.config.filter_view_graph import FilterViewGraphOptions
from snakesfm.errors import SceneError
from snakesfm.geometry.rotations import angle_of
from snakesfm.stages import average_rotations, build_view_graph, filter_view_graph
from snakesfm.stages.job import StageJob

IMAGES = 14
GROUP = 11


def geometries(pairs, rotations, rejections):
    count = len(pairs)
    missing = rejections != 0
    rotations = np.where(missing[:, None, None], np.nan, rotations)
    return TwoViewGeometries(
        pairs=pairs,
        digests=["x"] * count,
        rotations=rotations,
        translations=np.where(missing[:, None], np.nan, np.tile([1.0, 0, 0], (count, 1))),
        covariances=np.where(missing[:, None, None], np.nan, np.tile(1e-5 * np.eye(5), (count, 1, 1))),
        kinds=np.zeros(count, np.int8),
        rejections=rejections,
        match_counts=np.full(count, 200),
        inlier_counts=np.full(count, 120),
        inlier_ratios=np.full(count, 0.6),
        triangulation_angles_deg=np.full(count, 5.0),
        offsets=np.arange(count + 1),
        inliers=np.zeros((count, 2), np.int32),
    )


@pytest.fixture
def scene(tmp_path):
    """Eleven images with every pair, three apart as a triangle; one wrong edge, two rejected pairs."""
    rng = np.random.default_rng(0)
    truth = Rotation.random(IMAGES, rng).as_matrix()
    pairs = np.array(
        [(i, j) for i in range(IMAGES) for j in range(i + 1, IMAGES) if (i < GROUP) == (j < GROUP)]
    )
    noise = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=(len(pairs), 3))).as_matrix()
    rotations = noise @ truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    rotations[5] = Rotation.from_rotvec([0, 1.0, 0]).as_matrix() @ rotations[5]
    rejections = np.zeros(len(pairs), np.int8)
    rejections[[8, 20]] = 3

    def job(stage, options, name, **inputs):
        return StageJob(
            stage=stage, scene="test", inputs=inputs, outputs=(tmp_path / f"{name}.h5",), options=options
        )

    header = job("index_images", BuildViewGraphOptions(), "index").header
    names = [f"{row:02d}.jpg" for row in range(IMAGES)]
    write_plain_index(tmp_path / "index.h5", names, [(640, 480)] * IMAGES)
    tiles = []
    for tile in range(3):
        rows = np.arange(len(pairs)) % 3 == 2 - tile
        tiles.append(tmp_path / f"tile{tile}.h5")
        geometries(pairs[rows], rotations[rows], rejections[rows]).write(tiles[-1], header)
    empty = tmp_path / "empty.h5"
    geometries(np.zeros((0, 2), int), np.zeros((0, 3, 3)), np.zeros(0, np.int8)).write(empty, header)
    return tmp_path, job, [*tiles, empty], truth, pairs


def run_all(scene, filter_options, average_options):
    folder, job, tiles, _, _ = scene
    index = folder / "index.h5"
    build_view_graph.run(
        job("build_view_graph", BuildViewGraphOptions(), "graph", index=index, geometries=tiles)
    )
    filter_view_graph.run(
        job("filter_view_graph", filter_options, "filtered", index=index, graph=folder / "graph.h5")
    )
    average_rotations.run(
        job("average_rotations", average_options, "rotations", index=index, graph=folder / "filtered.h5")
    )
    return (
        ViewGraph.read(folder / "graph.h5"),
        ViewGraph.read(folder / "filtered.h5"),
        CameraRotations.read(folder / "rotations.h5"),
    )


@pytest.mark.parametrize("method", ["message_passing", "cycles"])
@pytest.mark.parametrize("averager", ["two_stage", "irls", "shonan"])
def test_three_stages_recover_the_rotations(scene, method, averager):
    truth, pairs = scene[3], scene[4]
    graph, filtered, averaged = run_all(
        scene, FilterViewGraphOptions(method=method), AverageRotationsOptions(method=averager)
    )
    np.testing.assert_array_equal(graph.pairs, np.delete(pairs, [8, 20], axis=0))
    assert (graph.labels == 0).all() and np.isnan(graph.cycle_min_deg).all()
    np.testing.assert_array_equal(graph.components, (np.arange(IMAGES) >= GROUP).astype(int))
    wrong = np.flatnonzero((filtered.pairs == (0, 6)).all(axis=1))
    labels = np.array(EDGE_LABELS)[filtered.labels]
    assert labels[wrong] == ("cycle_message" if method == "message_passing" else "cycle_min")
    apart = filtered.pairs[:, 0] >= GROUP
    assert np.count_nonzero(labels == "kept") == len(labels) - 1
    assert 0.01 < np.median(filtered.cycle_median_deg) < 2.0
    known = np.isfinite(averaged.rotations[:, 0, 0])
    np.testing.assert_array_equal(known, np.arange(IMAGES) < GROUP)
    np.testing.assert_allclose(averaged.rotations[0], np.eye(3), atol=1e-12)
    gauge = averaged.rotations[known].transpose(0, 2, 1) @ truth[known]
    errors = np.degrees(angle_of(gauge @ Rotation.from_matrix(gauge).mean().as_matrix().T))
    assert 0.02 < errors.mean() < 0.5
    # three images apart are too few for rotations of their own
    small = EDGE_LABELS.index("component")
    np.testing.assert_array_equal(averaged.labels, np.where(apart, small, filtered.labels))
    np.testing.assert_array_equal(averaged.components, np.where(known, 0, -1))
    assert 40 < averaged.residuals_deg[wrong] < 70
    np.testing.assert_array_equal(np.isnan(averaged.residuals_deg), apart)


def test_residuals_refuse_what_the_filter_left(scene):
    options = FilterViewGraphOptions(
        method="cycles", first_pass="none", second_pass="none", cluster_vote=False
    )
    _, filtered, averaged = run_all(scene, options, AverageRotationsOptions())
    assert np.count_nonzero(filtered.labels) == 0
    wrong = (filtered.pairs == (0, 6)).all(axis=1)
    assert EDGE_LABELS[averaged.labels[wrong][0]] == "rotation_residual"
    apart = filtered.pairs[:, 0] >= GROUP
    assert (averaged.labels[~wrong & ~apart] == 0).all()


@pytest.mark.parametrize(("least", "reason"), [(0.0, "cycle_message"), (6.0, "kept")])
def test_few_cycles_refuse_nothing(scene, least, reason):
    folder, job, _, truth, _ = scene
    header = job("x", BuildViewGraphOptions(), "x").header
    # each image with the next three, so an edge is in two cycles or three
    pairs = np.array([(i, j) for i in range(IMAGES) for j in range(i + 1, min(i + 4, IMAGES))])
    rotations = truth[pairs[:, 1]] @ truth[pairs[:, 0]].transpose(0, 2, 1)
    wrong = int(np.flatnonzero((pairs == (5, 7)).all(axis=1))[0])
    rotations[wrong] = Rotation.from_rotvec([0, 1.0, 0]).as_matrix() @ rotations[wrong]
    tile = folder / "band.h5"
    geometries(pairs, rotations, np.zeros(len(pairs), np.int8)).write(tile, header)
    _, filtered, averaged = run_all(
        (folder, job, [tile], None, None),
        FilterViewGraphOptions(min_cycles_per_edge=least),
        AverageRotationsOptions(),
    )
    assert EDGE_LABELS[filtered.labels[wrong]] == reason
    refused = "rotation_residual" if reason == "kept" else reason
    assert EDGE_LABELS[averaged.labels[wrong]] == refused
    assert np.flatnonzero(averaged.labels).tolist() == [wrong]


def test_scene_without_overlap_is_a_clear_error(scene):
    folder, job, tiles, _, _ = scene
    stage = job(
        "build_view_graph", BuildViewGraphOptions(), "g", index=folder / "index.h5", geometries=tiles[-1:]
    )
    with pytest.raises(SceneError, match="No two images"):
        build_view_graph.run(stage)
    assert not (folder / "g.h5").exists()


def test_contradictory_triangle_still_gives_rotations(scene):
    folder, job, _, _, _ = scene
    header = job("x", BuildViewGraphOptions(), "x").header
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    rotations = Rotation.from_euler("xyz", [[0, 0, 0], [50, 0, 0], [0, 50, 0]], degrees=True).as_matrix()
    tile = folder / "triangle.h5"
    geometries(pairs, rotations, np.zeros(3, np.int8)).write(tile, header)
    for method in ("two_stage", "irls", "shonan"):
        _, filtered, averaged = run_all(
            (folder, job, [tile], None, None),
            FilterViewGraphOptions(),
            AverageRotationsOptions(method=method),
        )
        assert np.count_nonzero(averaged.labels == 0) >= 1
        known = np.isfinite(averaged.rotations[:, 0, 0])
        assert known.sum() >= 2
        assert np.count_nonzero(filtered.labels == 0) >= 2
