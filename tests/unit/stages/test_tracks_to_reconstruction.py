"""The stages from tracks to the adjusted model, on a small synthetic scene."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_scene import HEADER, write_features, write_geometries, write_scene

from snakesfm.artifacts import (
    CalibratedCameras,
    CameraCenters,
    CameraRotations,
    Reconstruction,
    TrackTable,
    TriangulatedPoints,
    TwoViewGeometries,
    ViewGraph,
)
from snakesfm.artifacts.pairs import REJECTIONS
from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.config.build_tracks import BuildTracksOptions
from snakesfm.config.triangulate_tracks import TriangulateTracksOptions
from snakesfm.errors import SceneError
from snakesfm.geometry.camera import cameras_to_columns
from snakesfm.geometry.rotations import angle_of
from snakesfm.stages import adjust_bundle, build_tracks, triangulate_tracks
from snakesfm.stages.job import StageJob
from snakesfm.stages.triangulate_tracks import LEAST_SHARE
from snakesfm.synthetic.problems import make_problem, perturb_rotations

COUNT = 12


@pytest.fixture
def made():
    return make_problem(COUNT, 300, noise_px=0.3, seed=7)


@pytest.fixture
def inputs(made, tmp_path):
    """Averaged poses with noise, none of image 5."""
    inputs = write_scene(made, tmp_path)
    rotations = perturb_rotations(made.rotations, 0.3, 1)
    rotations[5] = np.nan
    edges = len(made.pairs)
    components = np.where(np.arange(COUNT) == 5, -1, 0)
    CameraRotations(rotations, np.zeros(edges), np.zeros(edges, int), components).write(
        inputs["rotations"], HEADER
    )
    centers = made.centers + np.random.default_rng(0).normal(0, 0.01, (COUNT, 3))
    centers[5] = np.nan
    CameraCenters(centers, components, np.zeros(edges), np.zeros(0)).write(inputs["centers"], HEADER)
    return inputs


def run(stage, options, inputs, output, **settings):
    stage.run(StageJob(stage.__name__.split(".")[-1], "scene", inputs, (output,), options, settings, 1))


def run_all(inputs, tmp_path, name="model.h5", detector_shorter_side_px=None, **options):
    side = (
        {} if detector_shorter_side_px is None else {"detector_shorter_side_px": detector_shorter_side_px}
    )
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"], **side)
    run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"], **side)
    settings = {"intrinsics": "fixed", "images": str(tmp_path / "images"), **side}
    run(adjust_bundle, AdjustBundleOptions(**options), inputs, tmp_path / name, **settings)
    return Reconstruction.read(tmp_path / name)


def colors_of(observed):
    """Colours (L,3) of observed keypoints, as :func:`write_features` gives them."""
    image_ids = observed.image_ids.astype(int)
    return np.column_stack([7 + image_ids % 2, 10 * image_ids, observed.keypoint_ids % 256])


def test_stages_in_a_row(made, inputs, tmp_path, capsys):
    model = run_all(inputs, tmp_path)
    tracks, points = TrackTable.read(inputs["tracks"]), TriangulatedPoints.read(inputs["points"])
    assert not (tracks.image_ids == 5).any()
    lengths = np.diff(tracks.offsets)
    of_long = np.repeat(lengths >= 3, lengths)
    sparse = (
        np.bincount(tracks.image_ids[of_long], minlength=COUNT) < BuildTracksOptions().sparse_observations
    )
    with_sparse = np.add.reduceat(sparse[tracks.image_ids], tracks.offsets[:-1]) > 0
    assert 0 < (lengths == 2).sum() == (with_sparse & (lengths == 2)).sum()
    for row in (0, len(tracks.image_ids) - 1):
        np.testing.assert_array_equal(
            tracks.keypoints[row], made.keypoints[tracks.image_ids[row]][tracks.keypoint_ids[row]]
        )
    np.testing.assert_array_equal(tracks.colors, colors_of(tracks))
    for found in (points, model):
        sums = np.add.reduceat(colors_of(found), found.offsets[:-1])
        np.testing.assert_allclose(found.colors, sums / np.diff(found.offsets)[:, None], atol=0.5)
    assert 0.9 < len(points.points) / (len(tracks.offsets) - 1) <= 1.0
    # the image without a rotation is registered by its matches to points
    assert np.isfinite(model.rotations).all() and (model.image_ids == 5).any()
    relative = model.rotations @ model.rotations[0].T
    true = made.rotations @ made.rotations[0].T
    errors = np.degrees(angle_of(np.einsum("nij,nkj->nik", relative, true)))[1:]
    assert 1e-3 < errors.mean() < 0.3
    assert 0.15 < np.average(model.errors_px, weights=np.diff(model.offsets)) < 0.6
    np.testing.assert_array_equal(model.camera_params[0, :4], made.cameras[0].params)
    assert model.round_names.tolist() == ["round 1", "round 2", "round 3", "registration", "last pass"]
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


@pytest.mark.parametrize(
    ("changes", "held", "told"),
    [
        ({}, False, ""),
        ({"refine_focal": False}, True, ""),
        ({"max_focal_change": 1.0 + 1e-9}, True, "focal length"),
    ],
)
def test_cameras_that_were_reset_are_told_of(made, inputs, tmp_path, capsys, changes, held, told):
    run_all(inputs, tmp_path)
    options = AdjustBundleOptions(refine_keypoints=False, **changes)
    capsys.readouterr()
    run(adjust_bundle, options, inputs, tmp_path / "model.h5", intrinsics="refine")
    model = Reconstruction.read(tmp_path / "model.h5")
    assert model.camera_resets.tolist() == [told]
    assert (model.camera_params[0, 0] == made.cameras[0].params[0]) == held
    lines = [line for line in capsys.readouterr().out.splitlines() if "cameras reset" in line]
    names = ["round 1", "round 2", "round 3", "registration", "last pass"] if told else []
    cause = "cameras reset because their focal length was implausible"
    assert lines == [f"{name}: {cause}: 1" for name in names]


def test_larger_photographs_give_the_same_model(made, inputs, tmp_path):
    """Four is a power of two, so all numbers are the same but for their exponents."""
    small = run_all(inputs, tmp_path, refine_keypoints=False)
    large_made = replace(
        made,
        cameras=tuple(camera.scaled(4.0) for camera in made.cameras),
        keypoints=tuple(keypoints * 4 for keypoints in made.keypoints),
    )
    folder = tmp_path / "large"
    folder.mkdir()
    paths = write_scene(large_made, folder) | {name: inputs[name] for name in ("rotations", "centers")}
    shorter = min(made.cameras[0].width, made.cameras[0].height)
    large = run_all(paths, folder, detector_shorter_side_px=shorter, refine_keypoints=False)
    np.testing.assert_array_equal(large.rotations, small.rotations)
    np.testing.assert_array_equal(large.translations, small.translations)
    np.testing.assert_array_equal(large.points, small.points)
    np.testing.assert_array_equal(large.keypoint_ids, small.keypoint_ids)
    np.testing.assert_array_equal(large.keypoints, 4 * small.keypoints)
    np.testing.assert_array_equal(large.camera_params, [camera_row(c) for c in large_made.cameras])
    np.testing.assert_array_equal(large.round_errors_px, small.round_errors_px)
    np.testing.assert_allclose(large.errors_px, 4 * small.errors_px, rtol=1e-9, atol=1e-9)
    strict = run_all(paths, folder, refine_keypoints=False)
    assert len(strict.image_ids) < len(small.image_ids)


def camera_row(camera):
    """A camera's parameters as artifacts hold them."""
    return cameras_to_columns([camera])[2][0]


def test_refused_edges_make_no_tracks(inputs):
    averaged = CameraRotations.read(inputs["rotations"])
    replace(averaged, labels=np.ones(len(averaged.labels), np.int8)).write(inputs["rotations"], HEADER)
    kept = (
        "'scene': no point is seen in {} images along the 0 kept image pairs: add images with more overlap"
    )
    with pytest.raises(SceneError, match=kept.format(2) + r"\.$"):
        run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    options = BuildTracksOptions(sparse_observations=0)
    with pytest.raises(SceneError, match=kept.format(3) + r" or lower build_tracks\.min_length\.$"):
        run(build_tracks, options, inputs, inputs["tracks"])


def test_edges_that_rotation_averaging_took_back_make_tracks(inputs):
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    expected = inputs["tracks"].read_bytes()
    graph = ViewGraph.read(inputs["graph"])
    replace(graph, labels=np.arange(len(graph.pairs)) % 2).write(inputs["graph"], HEADER)
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    assert inputs["tracks"].read_bytes() == expected


@pytest.mark.parametrize(("settings", "merged"), [({}, False), ({"detector_shorter_side_px": 240}, True)])
def test_keypoints_are_merged_within_detector_pixels(made, inputs, tmp_path, capsys, settings, merged):
    # the first image's keypoints of one pair lie 1.5 px beside those of its other pairs
    row = np.flatnonzero((made.pairs[:, 0] == 0) & (made.pairs[:, 1] != 5))[1]
    own, matches = made.keypoints[0], made.matches.copy()
    matches[made.match_offsets[row] : made.match_offsets[row + 1], 0] += len(own)
    beside = np.concatenate([own, own + np.float32([1.5, 0.0])])
    doubled = replace(made, keypoints=(beside, *made.keypoints[1:]), matches=matches)
    inputs |= {
        "features": write_features(doubled, tmp_path),
        "geometries": write_geometries(doubled, tmp_path),
    }
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"], **settings)
    conflicts = int(capsys.readouterr().out.split("; ")[1].split()[0])
    assert (
        conflicts == 0
        if merged
        else 10 < conflicts <= made.match_offsets[row + 1] - made.match_offsets[row]
    )


def test_where_every_track_sees_an_image_twice_it_is_told(inputs):
    for path in inputs["geometries"]:
        # every match of a pair is joined with the next one
        tile = TwoViewGeometries.read(path)
        joined = np.concatenate(
            [tile.inliers, np.column_stack([tile.inliers[:-1, 0], tile.inliers[1:, 1]])]
        )
        pair_of = np.repeat(np.arange(len(tile.pairs)), np.diff(tile.offsets))
        within = np.flatnonzero(np.diff(pair_of) == 0)
        joined = joined[np.r_[: len(pair_of), len(pair_of) + within]]
        pair_of = np.r_[pair_of, pair_of[within]]
        joined = joined[np.argsort(pair_of, kind="stable")]
        offsets = np.r_[0, np.cumsum(np.bincount(pair_of, minlength=len(tile.pairs)))]
        replace(tile, inliers=joined, offsets=offsets).write(path, HEADER)
    told = r"in 2 images .* pairs \(.*two places: 1\): add .*overlap\.$"
    with pytest.raises(SceneError, match=told):
        run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])


def test_poses_that_fit_nothing_are_named(inputs):
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    centers = CameraCenters.read(inputs["centers"])
    columns = dict(vars(centers)) | {"centers": np.full((COUNT, 3), np.nan)}
    CameraCenters(**columns).write(inputs["centers"], HEADER)
    told = r"none of the \d+ tracks is seen by two images with a position: see in the logs of"
    with pytest.raises(SceneError, match=told) as refused:
        run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
    assert "tripod" not in str(refused.value)


@pytest.mark.parametrize("near", [0.01, 0.04])
def test_photographs_from_one_position_are_refused_and_far_scenes_are_not(made, inputs, near):
    """Cameras that all look one way at what is far beyond any depth, but for a share of the tracks."""
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    tracks, averaged = TrackTable.read(inputs["tracks"]), CameraRotations.read(inputs["rotations"])
    turned = np.isfinite(averaged.rotations[:, :1, :1])
    replace(averaged, rotations=np.where(turned, np.eye(3), np.nan)).write(inputs["rotations"], HEADER)
    lengths = np.diff(tracks.offsets)
    random = np.random.default_rng(3)
    extent = np.ptp(made.centers)
    depths = np.where(np.arange(len(lengths)) < near * len(lengths), 3.0, 1e5) * extent
    slopes = random.uniform(-0.2, 0.2, (len(lengths), 2))
    points = np.column_stack([slopes, np.ones(len(lengths))]) * depths[:, None]
    centers = CameraCenters.read(inputs["centers"]).centers[tracks.image_ids]
    seen = np.nan_to_num(np.repeat(points, lengths, axis=0) - centers, nan=1.0)
    focal, center = made.cameras[0].focal_px, made.cameras[0].params[-2:]
    keypoints = focal * seen[:, :2] / seen[:, 2:] + center
    replace(tracks, keypoints=keypoints.astype(np.float32)).write(inputs["tracks"], HEADER)
    if near < LEAST_SHARE:
        with pytest.raises(SceneError, match=r"'scene': \d of \d+ tracks .* all taken from one position"):
            run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
    else:
        run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
        found = len(TriangulatedPoints.read(inputs["points"]).points)
        assert 0.5 * near * len(lengths) < found < 0.1 * len(lengths)


def test_matches_of_refused_pairs_bring_observations_where_the_model_agrees(made, inputs, tmp_path):
    graph = ViewGraph.read(inputs["graph"])
    # every third pair has matches but no pose that was believed
    accepted = np.arange(len(graph.pairs)) % 3 != 1
    edges = {
        name: value[accepted] if len(value) == len(accepted) else value
        for name, value in vars(graph).items()
    }
    ViewGraph(**edges).write(inputs["graph"], HEADER)
    rotations = CameraRotations.read(inputs["rotations"])
    CameraRotations(
        rotations.rotations, np.zeros(accepted.sum()), np.zeros(accepted.sum(), int), rotations.components
    ).write(inputs["rotations"], HEADER)
    refused_pairs = set(map(tuple, graph.pairs[~accepted].tolist()))
    found = {}
    for case in (("not_significant", True), ("not_significant", False), ("ambiguous", True)):
        for path in inputs["geometries"]:
            columns = dict(vars(TwoViewGeometries.read(path)))
            refused = np.array([tuple(pair) in refused_pairs for pair in columns["pairs"].tolist()], bool)
            columns["rejections"] = np.where(refused, REJECTIONS.index(case[0]), 0).astype(np.int8)
            TwoViewGeometries(**columns).write(path, HEADER)
        model = run_all(
            inputs,
            tmp_path,
            f"{case[0]}{case[1]}.h5",
            complete_refused_pairs=case[1],
            sparse_observations=0,
        )
        found[case] = np.diff(model.offsets)
        assert np.isfinite(model.rotations[:, 0, 0]).sum() >= COUNT - 1
        assert 0.15 < np.average(model.errors_px, weights=found[case]) < 0.6
    assert len(refused_pairs) > 5
    more, without, ambiguous = found.values()
    assert 1.1 < more.sum() / without.sum() < 2
    np.testing.assert_array_equal(ambiguous, without)


def test_a_principal_point_that_seems_too_far_off_is_told_of(made, inputs, tmp_path):
    (camera,) = made.cameras
    # beyond what is believed, however much the errors fall
    shifted = replace(camera, params=(*camera.params[:2], 80.0, *camera.params[3:]))
    models, sizes, params, sources = cameras_to_columns([shifted])
    replace(
        CalibratedCameras.read(inputs["cameras"]),
        models=models,
        sizes=sizes,
        params=params,
        sources=sources,
    ).write(inputs["cameras"], HEADER)
    run_all(inputs, tmp_path)
    run(
        adjust_bundle,
        AdjustBundleOptions(refine_keypoints=False),
        inputs,
        tmp_path / "model.h5",
        intrinsics="refine",
    )
    model = Reconstruction.read(tmp_path / "model.h5")
    assert model.camera_params[0, 2] == 80.0
    assert 0.35 < model.camera_offsets[0] < 0.4
