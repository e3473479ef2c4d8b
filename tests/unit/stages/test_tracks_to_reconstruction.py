"""The stages from tracks to the adjusted model, on a small synthetic scene."""

import numpy as np
import pytest

from snakesfm.artifacts import (
    CalibratedCameras,
    CameraCenters,
    CameraRotations,
    Header,
    ImageIndex,
    LocalFeatures,
    Reconstruction,
    TrackTable,
    TriangulatedPoints,
    TwoViewGeometries,
    ViewGraph,
)
from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.config.build_tracks import BuildTracksOptions
from snakesfm.config.triangulate_tracks import TriangulateTracksOptions
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import cameras_to_columns
from snakesfm.geometry.rotations import angle_of
from snakesfm.stages import adjust_bundle, build_tracks, triangulate_tracks
from snakesfm.stages.job import StageJob
from snakesfm.synthetic.problems import make_problem, perturb_rotations

HEADER = Header("test", 1, "scene")
COUNT = 12


def write_features(made, folder, blocks=2):
    paths = []
    for block in range(blocks):
        ids = np.arange(COUNT)[block::blocks]
        points = np.concatenate([made.keypoints[i] for i in ids])
        count = len(points)
        path = folder / f"features{block}.h5"
        LocalFeatures(
            image_ids=ids,
            names=[f"{i}.jpg" for i in ids],
            digests=[""] * len(ids),
            sizes=np.tile([640, 480], (len(ids), 1)),
            offsets=np.r_[0, np.cumsum([len(made.keypoints[i]) for i in ids])],
            keypoints=points,
            descriptors=np.zeros((count, 8), np.uint8),
            scores=np.ones(count, np.float32),
            scales=np.ones(count, np.float32),
            angles=np.zeros(count, np.float32),
            colors=np.full((count, 3), 7 + block, np.uint8),
        ).write(path, HEADER)
        paths.append(path)
    return paths


def write_geometries(made, folder):
    """Two tiles; the first pair is rejected."""
    paths = []
    rejected = np.r_[3, np.zeros(len(made.pairs) - 1, int)]
    for tile, rows in enumerate((np.arange(0, len(made.pairs), 2), np.arange(1, len(made.pairs), 2))):
        parts = [made.matches[made.match_offsets[r] : made.match_offsets[r + 1]] for r in rows]
        path = folder / f"tile{tile}.h5"
        TwoViewGeometries(
            pairs=made.pairs[rows],
            digests=[""] * len(rows),
            rotations=made.edge_rotations[rows],
            translations=made.edge_translations[rows],
            covariances=made.edge_covariances[rows],
            kinds=np.zeros(len(rows), int),
            rejections=rejected[rows],
            match_counts=np.array([len(p) for p in parts]),
            inlier_counts=np.array([len(p) for p in parts]),
            inlier_ratios=np.ones(len(rows)),
            triangulation_angles_deg=made.edge_angles_deg[rows],
            offsets=np.r_[0, np.cumsum([len(p) for p in parts])],
            inliers=np.concatenate(parts),
        ).write(path, HEADER)
        paths.append(path)
    return paths


@pytest.fixture
def made():
    return make_problem(COUNT, 300, noise_px=0.3, seed=7)


@pytest.fixture
def inputs(made, tmp_path):
    models, sizes, params, sources = cameras_to_columns(made.cameras)
    ImageIndex(
        names=[f"{i}.jpg" for i in range(COUNT)],
        sizes=np.tile(sizes, (COUNT, 1)),
        sha256=[""] * COUNT,
        blocks=np.arange(COUNT) % 2,
        camera_ids=made.camera_ids,
        orientations=np.ones(COUNT, int),
        focal_exif_px=np.full(COUNT, np.nan),
        gps=np.full((COUNT, 3), np.nan),
        duplicate_of=np.full(COUNT, -1),
        camera_models=models,
        camera_sizes=sizes,
        camera_params=params,
        camera_sources=sources,
        refused_names=[],
        refused_reasons=[],
    ).write(tmp_path / "index.h5", HEADER)
    CalibratedCameras(models, sizes, params, sources, np.array([np.nan]), np.array([0])).write(
        tmp_path / "cameras.h5", HEADER
    )
    edges = len(made.pairs)
    ViewGraph(
        pairs=made.pairs,
        rotations=made.edge_rotations,
        translations=made.edge_translations,
        covariances=made.edge_covariances,
        kinds=np.zeros(edges, int),
        inlier_counts=made.edge_inlier_counts,
        triangulation_angles_deg=made.edge_angles_deg,
        labels=np.zeros(edges, int),
        cycle_min_deg=np.zeros(edges),
        cycle_median_deg=np.zeros(edges),
        components=np.zeros(COUNT, int),
    ).write(tmp_path / "graph.h5", HEADER)
    rotations = perturb_rotations(made.rotations, 0.3, 1)
    rotations[5] = np.nan
    CameraRotations(rotations, np.zeros(edges), np.zeros(edges, int)).write(
        tmp_path / "rotations.h5", HEADER
    )
    centers = made.centers + np.random.default_rng(0).normal(0, 0.01, (COUNT, 3))
    centers[5] = np.nan
    CameraCenters(centers, np.zeros(edges), np.ones(edges, bool), np.zeros(0, int), np.zeros(0)).write(
        tmp_path / "centers.h5", HEADER
    )
    names = ("index", "cameras", "graph", "rotations", "centers", "tracks", "points")
    return {name: tmp_path / f"{name}.h5" for name in names} | {
        "features": write_features(made, tmp_path),
        "geometries": write_geometries(made, tmp_path),
    }


def run(stage, options, inputs, output, **settings):
    stage.run(StageJob(stage.__name__.split(".")[-1], "scene", inputs, (output,), options, settings, 1))


def run_all(inputs, tmp_path, name="model.h5", **options):
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
    settings = {"intrinsics": "fixed", "images": str(tmp_path / "images")}
    run(adjust_bundle, AdjustBundleOptions(**options), inputs, tmp_path / name, **settings)
    return Reconstruction.read(tmp_path / name)


def test_stages_in_a_row(made, inputs, tmp_path, capsys):
    model = run_all(inputs, tmp_path)
    tracks, points = TrackTable.read(inputs["tracks"]), TriangulatedPoints.read(inputs["points"])
    assert not (tracks.image_ids == 5).any() and np.diff(tracks.offsets).min() >= 3
    for row in (0, len(tracks.image_ids) - 1):
        np.testing.assert_array_equal(
            tracks.keypoints[row], made.keypoints[tracks.image_ids[row]][tracks.keypoint_ids[row]]
        )
        assert tracks.colors[row, 0] == 7 + tracks.image_ids[row] % 2
    assert 0.9 < len(points.points) / (len(tracks.offsets) - 1) <= 1.0
    # the image without a rotation is registered by its matches to points
    assert np.isfinite(model.rotations).all() and (model.image_ids == 5).any()
    relative = model.rotations @ model.rotations[0].T
    true = made.rotations @ made.rotations[0].T
    errors = np.degrees(angle_of(np.einsum("nij,nkj->nik", relative, true)))[1:]
    assert 1e-3 < errors.mean() < 0.3
    assert 0.15 < np.average(model.errors_px, weights=np.diff(model.offsets)) < 0.6
    np.testing.assert_array_equal(model.camera_params[0, :4], made.cameras[0].params)
    assert model.round_names.tolist() == ["round 1", "round 2", "round 3", "registration"]
    assert model.round_counts[-1].tolist() == [COUNT, len(model.points), len(model.image_ids)]
    assert model.round_errors_px[-1] == pytest.approx(model.errors_px.mean(), abs=0.02)
    printed = capsys.readouterr().out
    assert "round 3: cost" in printed
    # the scene has no photographs: keypoints stay as they are, and that is said
    assert "images/3.jpg does not exist" in printed and "keypoints refined: 0 of" in printed
    base = np.r_[0, np.cumsum([len(points) for points in made.keypoints])]
    np.testing.assert_array_equal(
        model.keypoints, np.concatenate(made.keypoints)[base[model.image_ids] + model.keypoint_ids]
    )


def test_same_bytes_again(inputs, tmp_path):
    run_all(inputs, tmp_path, "a.h5")
    run_all(inputs, tmp_path, "b.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_refused_edges_make_no_tracks(inputs):
    graph = ViewGraph.read(inputs["graph"])
    columns = dict(vars(graph)) | {"labels": np.ones(len(graph.pairs), np.int8)}
    ViewGraph(**columns).write(inputs["graph"], HEADER)
    with pytest.raises(SceneError, match=r"'scene'.*min_length"):
        run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])


def test_poses_that_fit_nothing_are_named(inputs):
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    centers = CameraCenters.read(inputs["centers"])
    columns = dict(vars(centers)) | {"centers": np.full((COUNT, 3), np.nan)}
    CameraCenters(**columns).write(inputs["centers"], HEADER)
    with pytest.raises(SceneError, match="none of"):
        run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
