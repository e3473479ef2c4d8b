"""A scene of parts that nothing ties together: a model of each, from the averagings to the export."""

import json
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from synthetic_scene import HEADER, side_by_side, true_model, write_scene

from snakesfm.artifacts import (
    CameraCenters,
    CameraRotations,
    Reconstruction,
    TrackTable,
    TriangulatedPoints,
)
from snakesfm.artifacts.gather import gather_image_columns, gather_inlier_matches
from snakesfm.bundle import rounds
from snakesfm.bundle.model import restrict_to
from snakesfm.bundle.models import join_models, tied_images
from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.config.average_rotations import AverageRotationsOptions
from snakesfm.config.average_translations import AverageTranslationsOptions
from snakesfm.config.build_tracks import BuildTracksOptions
from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.config.export_model import ExportModelOptions
from snakesfm.config.triangulate_tracks import TriangulateTracksOptions
from snakesfm.geometry.rotations import angle_of
from snakesfm.stages import (
    adjust_bundle,
    average_rotations,
    average_translations,
    build_tracks,
    evaluate_model,
    export_model,
    triangulate_tracks,
)
from snakesfm.stages.job import StageJob
from snakesfm.stages.triangulate_tracks import split_by_frame
from snakesfm.synthetic.problems import make_problem

SMALL, LARGE = 10, 14
COUNT = SMALL + LARGE
PART = np.arange(COUNT) >= SMALL


@pytest.fixture(scope="module")
def made():
    small, large = (make_problem(n, 800, noise_px=0.3, seed=n) for n in (SMALL, LARGE))
    return side_by_side(small, large)


def run(stage, options, inputs, output, *more, **settings):
    name = stage.__name__.split(".")[-1]
    stage.run(StageJob(name, "scene", inputs, (output, *more), options, settings, 1))


@pytest.fixture(scope="module")
def scene(made, tmp_path_factory):
    """The inputs by name, every stage run."""
    folder = tmp_path_factory.mktemp("scene")
    inputs = write_scene(made, folder)
    settings = {"intrinsics": "fixed", "images": str(folder / "images")}
    run(average_rotations, AverageRotationsOptions(), inputs, inputs["rotations"])
    run(build_tracks, BuildTracksOptions(), inputs, inputs["tracks"])
    run(average_translations, AverageTranslationsOptions(), inputs, inputs["centers"])
    run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
    options = AdjustBundleOptions(refine_keypoints=False)
    run(adjust_bundle, options, inputs, inputs["reconstruction"], **settings)
    return inputs


def rotation_errors_deg(rotations, truth):
    relative, true = rotations @ rotations[0].T, truth @ truth[0].T
    return np.degrees(angle_of(relative @ true.transpose(0, 2, 1)))[1:]


def test_each_part_is_averaged_in_a_world_of_its_own(made, scene):
    averaged = CameraRotations.read(scene["rotations"])
    np.testing.assert_array_equal(averaged.components, np.where(PART, 0, 1))
    centers = CameraCenters.read(scene["centers"]).centers
    for part in (PART, ~PART):
        assert rotation_errors_deg(averaged.rotations[part], made.rotations[part]).max() < 2.0
        found, true = (c[part] - np.median(c[part], axis=0) for c in (centers, made.centers))
        aligned = pycolmap.estimate_sim3d(found, true)
        errors = np.linalg.norm([aligned * c for c in found] - true, axis=1)
        assert errors.max() < 0.03 * np.ptp(true, axis=0).max()


def test_parts_that_are_too_small_stay_out(scene, tmp_path):
    options = AverageRotationsOptions(min_component_images=SMALL + 1)
    run(average_rotations, options, scene, tmp_path / "rotations.h5")
    averaged = CameraRotations.read(tmp_path / "rotations.h5")
    np.testing.assert_array_equal(averaged.components, np.where(PART, 0, -1))
    assert np.isnan(averaged.rotations[~PART]).all()


def test_each_part_becomes_a_model_the_largest_first(made, scene):
    model = Reconstruction.read(scene["reconstruction"])
    assert model.model_count == 2
    np.testing.assert_array_equal(model.models, np.where(PART, 0, 1))
    for number, part in ((0, PART), (1, ~PART)):
        one = model.select_model(number)
        np.testing.assert_array_equal(np.isfinite(one.rotations[:, 0, 0]), part)
        assert part[one.image_ids].all() and len(one.points) > 100
        assert np.diff(one.offsets).min() >= 3
        assert rotation_errors_deg(one.rotations[part], made.rotations[part]).max() < 0.5
        assert 0.15 < np.average(one.errors_px, weights=np.diff(one.offsets)) < 0.6
    assert "part 2, round 3" in model.round_names.tolist() and "round 3" in model.round_names.tolist()


def test_a_part_of_two_images_is_no_model(scene, tmp_path, capsys):
    averaged = CameraCenters.read(scene["centers"])
    kept = PART | np.isin(np.arange(COUNT), [2, 3])
    centers = np.where(kept[:, None], averaged.centers, np.nan)
    components = np.where(kept, averaged.components, -1)
    replace(averaged, centers=centers, components=components).write(tmp_path / "centers.h5", HEADER)
    inputs = scene | {"centers": tmp_path / "centers.h5"}
    options = AdjustBundleOptions(refine_keypoints=False)
    run(adjust_bundle, options, inputs, tmp_path / "model.h5", intrinsics="fixed", images="")
    told = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert told == ["part 2 is left out: 2 of its images are in no other model, and a model needs 3"]
    model = Reconstruction.read(tmp_path / "model.h5")
    np.testing.assert_array_equal(model.models, np.where(PART, 0, -1))
    assert len(model.points) > 100


@pytest.fixture
def one_turned(scene, tmp_path):
    """The inputs where averaging found one frame of rotations and two of positions, by images left out.

    Tracks of the first part are joined to some of the second, as by images that see both.
    """
    inputs = scene | {
        name: tmp_path / f"{name}.h5" for name in ("rotations", "tracks", "centers", "points")
    }
    averaged = CameraRotations.read(scene["rotations"])
    replace(averaged, components=np.zeros(COUNT, int)).write(inputs["rotations"], HEADER)
    tracks = TrackTable.read(scene["tracks"])
    last = PART[tracks.image_ids[tracks.offsets[:-1]]].argmax()
    run(
        average_translations,
        AverageTranslationsOptions(),
        inputs | {"tracks": scene["tracks"]},
        inputs["centers"],
    )
    ends = tracks.offsets[last : last + 101]
    order = np.arange(len(tracks.image_ids))
    starts = tracks.offsets[last - 100 : last]
    pieces, offsets = [], [0]
    for k in range(100):
        pieces += [order[starts[k] : tracks.offsets[last - 99 + k]], order[ends[k] : ends[k + 1]]]
        offsets.append(offsets[-1] + len(pieces[-2]) + len(pieces[-1]))
    rows = np.concatenate([order[: starts[0]], *pieces, order[ends[-1] :]])
    before, after = tracks.offsets[: last - 100], tracks.offsets[last + 101 :]
    columns = ("image_ids", "keypoint_ids", "part_ids", "keypoints", "colors")
    replace(
        tracks,
        offsets=np.r_[before, starts[0] + np.array(offsets), after],
        **{name: getattr(tracks, name)[rows] for name in columns},
    ).write(inputs["tracks"], HEADER)
    return inputs


def test_parts_of_one_frame_of_rotations_become_a_model_each(made, one_turned, tmp_path):
    centers = CameraCenters.read(one_turned["centers"])
    np.testing.assert_array_equal(centers.components, np.where(PART, 0, 1))
    run(triangulate_tracks, TriangulateTracksOptions(), one_turned, one_turned["points"])
    points = TriangulatedPoints.read(one_turned["points"])
    seen = np.add.reduceat(PART[points.image_ids], points.offsets[:-1], dtype=int)
    assert set(np.unique(seen / np.diff(points.offsets))) == {0.0, 1.0}
    options = AdjustBundleOptions(refine_keypoints=False, complete_tracks=False)
    run(adjust_bundle, options, one_turned, tmp_path / "model.h5", intrinsics="fixed", images="")
    model = Reconstruction.read(tmp_path / "model.h5")
    np.testing.assert_array_equal(model.models, np.where(PART, 0, 1))
    for part in (PART, ~PART):
        assert rotation_errors_deg(model.rotations[part], made.rotations[part]).max() < 0.5


def test_images_that_the_largest_model_registers_leave_their_part(made, scene, tmp_path):
    averaged = CameraCenters.read(scene["centers"])
    odd = np.isin(np.arange(COUNT), SMALL + np.arange(5))
    centers = np.where(odd[:, None], 0.3 * averaged.centers + 5.0, averaged.centers)
    components = np.where(odd, 2, averaged.components)
    inputs = scene | {"centers": tmp_path / "centers.h5", "points": tmp_path / "points.h5"}
    replace(averaged, centers=centers, components=components).write(inputs["centers"], HEADER)
    run(triangulate_tracks, TriangulateTracksOptions(), inputs, inputs["points"])
    options = AdjustBundleOptions(refine_keypoints=False)
    run(adjust_bundle, options, inputs, tmp_path / "model.h5", intrinsics="fixed", images="")
    model = Reconstruction.read(tmp_path / "model.h5")
    np.testing.assert_array_equal(model.models, np.where(PART, 0, 1))
    assert rotation_errors_deg(model.rotations[PART], made.rotations[PART]).max() < 0.5


def test_tracks_are_split_by_frame(one_turned):
    tracks = TrackTable.read(one_turned["tracks"])
    whole = split_by_frame(tracks, np.where(np.arange(COUNT) % 3 == 0, -1, 0))
    for name, values in vars(tracks).items():
        np.testing.assert_array_equal(getattr(whole, name), values)
    split = split_by_frame(tracks, np.where(PART, 0, 1))
    assert len(split.offsets) == len(tracks.offsets) + 100
    assert sorted(zip(split.image_ids, split.keypoint_ids, strict=True)) == sorted(
        zip(tracks.image_ids, tracks.keypoint_ids, strict=True)
    )
    for start, end in zip(split.offsets[:-1], split.offsets[1:], strict=True):
        assert len(set(PART[split.image_ids[start:end]])) == 1
        assert (np.diff(split.image_ids[start:end]) > 0).all()


def test_a_part_that_comes_apart_leaves_no_intrinsics_behind(scene, tmp_path):
    centers = CameraCenters.read(scene["centers"])
    scattered = np.random.default_rng(0).normal(0.0, 30.0, (LARGE, 3))
    found = []
    for name, wrong in (("apart", scattered), ("absent", np.nan)):
        inputs = scene | {"centers": tmp_path / f"{name}.h5"}
        mine = centers.centers.copy()
        mine[PART] = wrong
        replace(centers, centers=mine).write(inputs["centers"], HEADER)
        # completion and registration would mend the part
        options = AdjustBundleOptions(
            refine_keypoints=False, complete_tracks=False, register_images=False, min_observations=40
        )
        run(adjust_bundle, options, inputs, tmp_path / "model.h5", intrinsics="refine", images="")
        found.append(Reconstruction.read(tmp_path / "model.h5"))
    apart, absent = found
    assert apart.round_counts[apart.round_names.tolist().index("last pass"), 0] < 2
    np.testing.assert_array_equal(apart.models, np.where(PART, -1, 0))
    for column in ("camera_params", "camera_resets", "camera_offsets", "rotations", "points", "keypoints"):
        np.testing.assert_array_equal(getattr(apart, column), getattr(absent, column))


def test_a_part_is_given_its_own_images_and_those_tied_to_it(made, scene, tmp_path, monkeypatch):
    left_out = np.array([3, SMALL + 4])
    averaged = CameraCenters.read(scene["centers"])
    components, centers = averaged.components.copy(), averaged.centers.copy()
    components[left_out], centers[left_out] = -1, np.nan
    replace(averaged, components=components, centers=centers).write(tmp_path / "centers.h5", HEADER)
    given = []

    def adjust_rounds(reconstruction, *arguments):
        registered = np.array(sorted(reconstruction.reg_image_ids())) - 1
        given.append((np.array(sorted(reconstruction.images)) - 1, registered))
        return rounds.adjust_rounds(reconstruction, *arguments)

    monkeypatch.setattr(adjust_bundle, "adjust_rounds", adjust_rounds)
    inputs = scene | {"centers": tmp_path / "centers.h5"}
    options = AdjustBundleOptions(refine_keypoints=False)
    run(adjust_bundle, options, inputs, tmp_path / "model.h5", intrinsics="fixed", images="")
    for (images, registered), part in zip(given, (PART, ~PART), strict=True):
        np.testing.assert_array_equal(images, np.flatnonzero(part))
        np.testing.assert_array_equal(registered, np.setdiff1d(images, left_out))
    model = Reconstruction.read(tmp_path / "model.h5")
    np.testing.assert_array_equal(model.models, np.where(PART, 0, 1))
    for part in (PART, ~PART):
        assert rotation_errors_deg(model.rotations[part], made.rotations[part]).max() < 0.5


def test_a_camera_that_parts_share_is_held_in_the_second(scene, tmp_path, monkeypatch):
    held = []

    def adjust_rounds(reconstruction, read_graph, cameras, solving, *arguments):
        held.append(solving.constant_cameras)
        return rounds.adjust_rounds(reconstruction, read_graph, cameras, solving, *arguments)

    monkeypatch.setattr(adjust_bundle, "adjust_rounds", adjust_rounds)
    options = AdjustBundleOptions(refine_keypoints=False, thresholds_px=(4.0,), max_iterations=5)
    run(adjust_bundle, options, scene, tmp_path / "model.h5", intrinsics="refine", images="")
    assert held == [frozenset(), frozenset([1])]


def test_images_are_tied_by_chains_of_pairs():
    pairs = np.array([[0, 3], [3, 5], [1, 2], [4, 6]])
    posed = np.isin(np.arange(8), [0, 6])
    np.testing.assert_array_equal(np.flatnonzero(tied_images(pairs, posed)), [0, 3, 4, 5, 6])
    np.testing.assert_array_equal(tied_images(pairs[:0], posed), posed)


def test_only_what_is_wanted_is_gathered(made, scene):
    wanted = {0, 3, 4, COUNT - 1}
    (some,) = gather_image_columns(scene["features"], COUNT, "keypoints", images=wanted)
    for row, keypoints in enumerate(some):
        np.testing.assert_array_equal(keypoints, made.keypoints[row][: None if row in wanted else 0])
    rows = [2, 5, 6, len(made.pairs) - 1]
    pairs, offsets, matches = gather_inlier_matches(scene["geometries"], made.pairs[rows])
    np.testing.assert_array_equal(pairs, made.pairs[rows])
    for k, row in enumerate(rows):
        expected = made.matches[made.match_offsets[row] : made.match_offsets[row + 1]]
        np.testing.assert_array_equal(matches[offsets[k] : offsets[k + 1]], expected)


def test_models_are_exported_side_by_side_and_the_first_is_evaluated(made, scene, tmp_path):
    settings = {"images": str(tmp_path), "intrinsics": "fixed", "reference": ""}
    files = ("sparse/0/images.bin", "summary.json")
    options = ExportModelOptions(link_images=False)
    # of a run with more models
    (tmp_path / "sparse" / "7").mkdir(parents=True)
    run(export_model, options, scene, *(tmp_path / file for file in files), **settings)
    assert sorted(path.name for path in (tmp_path / "sparse").iterdir()) == ["0", "1"]
    for number, part in ((0, PART), (1, ~PART)):
        model = pycolmap.Reconstruction(str(tmp_path / "sparse" / str(number)))
        assert {image.name for image in model.images.values()} == {
            f"{row}.jpg" for row in np.flatnonzero(part)
        }
        model.update_point_3d_errors()
        assert 0.1 < model.compute_mean_reprojection_error() < 0.6
    summary = json.loads((tmp_path / "summary.json").read_text("utf-8"))
    assert (summary["registered_images"], summary["images_in_other_models"]) == (LARGE, [SMALL])
    assert summary["not_registered"] == [] and f"{SMALL} images could not be" in summary["warnings"][0]
    run(evaluate_model, EvaluateModelOptions(), scene, tmp_path / "metrics.json", **settings)
    metrics = json.loads((tmp_path / "metrics.json").read_text("utf-8"))
    assert (metrics["registered_images"], metrics["images_in_other_models"]) == (LARGE, SMALL)
    assert metrics["points"] == summary["points"]


def test_parts_of_a_model_joined_again_are_the_model(made):
    model = true_model(made)
    parts = [restrict_to(model, images) for images in (~PART, PART)]
    assert [int(part.registered.sum()) for part in parts] == [SMALL, LARGE]
    joined, labels = join_models(parts, made.cameras)
    np.testing.assert_array_equal(labels, PART.astype(int))
    for name in ("rotations", "translations", "points", "offsets", "image_ids", "keypoint_ids"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(model, name))


def test_a_point_that_one_image_of_a_part_sees_is_none_of_it(made):
    model = true_model(made)
    images = np.arange(COUNT) < 3
    part = restrict_to(model, images)
    assert images[part.image_ids].all() and np.diff(part.offsets).min() >= 2
    kept = images[model.image_ids]
    seen = np.add.reduceat(kept.astype(int), model.offsets[:-1])
    assert len(part.points) == np.count_nonzero(seen >= 2) < np.count_nonzero(seen)
