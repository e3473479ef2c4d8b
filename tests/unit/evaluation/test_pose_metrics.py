"""Pose errors, areas under recall curves, alignment: against brute force and exact truth."""

import json

import numpy as np
import pycolmap
import pytest
from synthetic_scene import true_model

from snakesfm.bundle.model import to_reconstruction
from snakesfm.config.evaluate_model import EvaluateModelOptions
from snakesfm.errors import ConfigError
from snakesfm.evaluation.__main__ import main
from snakesfm.evaluation.alignment import align_poses
from snakesfm.evaluation.colmap_model import find_model, model_poses, read_model
from snakesfm.evaluation.metrics import Poses, _distribution, evaluate_poses, model_metrics
from snakesfm.evaluation.pose_errors import (
    chordal_angle_deg,
    compared_images,
    pose_auc,
    relative_pose_errors,
)
from snakesfm.evaluation.scores import score_model
from snakesfm.geometry.poses import center_of, translation_of
from snakesfm.geometry.rotations import angle_of, exp_so3
from snakesfm.image_names import match_names
from snakesfm.synthetic.problems import make_problem

DEFAULTS = EvaluateModelOptions().model_dump()


def random_poses(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return exp_so3(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)) * 4.0


def transformed(rotations, centers, scale=2.5, seed=3):
    """The same cameras in a world that is turned, scaled and moved: (rotations, centers)."""
    rng = np.random.default_rng(seed)
    turn, shift = exp_so3(rng.normal(size=3)), rng.normal(size=3) * 10
    return rotations @ turn.T, scale * centers @ turn.T + shift, turn, shift


def named(rotations, centers, names=None) -> Poses:
    names = names or [f"{k:03d}.jpg" for k in range(len(rotations))]
    return Poses(names, rotations, translation_of(rotations, centers))


@pytest.mark.parametrize(
    ("errors", "threshold", "expected"),
    [
        ([0.0, 0.0], 1.0, 100.0),
        ([2.0, 2.0], 1.0, 0.0),
        ([1.0], 1.0, 50.0),
        ([0.5], 1.0, 75.0),
        ([0.5, 180.0], 1.0, 37.5),
        ([0.2, 0.6], 1.0, 100 * (0.2 * 0.25 + 0.4 * 0.75 + 0.4)),
        ([], 1.0, 0.0),
    ],
)
def test_auc_is_the_exact_area_of_the_linear_recall_curve(errors, threshold, expected) -> None:
    assert pose_auc(np.array(errors), [threshold])[0] == pytest.approx(expected)


def test_auc_grows_with_the_threshold_and_ignores_order() -> None:
    errors = np.random.default_rng(0).exponential(2.0, 300)
    areas = pose_auc(errors, [1.0, 3.0, 5.0, 20.0])
    assert areas == sorted(areas)
    assert areas == pytest.approx(pose_auc(errors[::-1], [1.0, 3.0, 5.0, 20.0]))


def test_chordal_angle_agrees_with_the_logarithm_from_tiny_to_half_turn() -> None:
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(6, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.array([1e-9, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-3])
    base = exp_so3(rng.normal(size=(6, 3)))
    assert chordal_angle_deg(base, exp_so3(axes * angles[:, None]) @ base) == pytest.approx(
        np.degrees(angles), rel=1e-5, abs=1e-6
    )


def test_relative_errors_equal_those_computed_pair_by_pair() -> None:
    rotations, translations = random_poses(7, 0)
    other_rotations, other_translations = random_poses(7, 1)
    rotation_deg, direction_deg = relative_pose_errors(
        rotations, translations, other_rotations, other_translations
    )
    expected = []
    for j in range(7):
        for i in range(7):
            if i == j:
                continue
            relative = rotations[j] @ rotations[i].T
            reference = other_rotations[j] @ other_rotations[i].T
            a = translations[j] - relative @ translations[i]
            b = other_translations[j] - reference @ other_translations[i]
            cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
            expected.append((np.degrees(angle_of(relative @ reference.T)), np.degrees(np.arccos(cosine))))
    assert rotation_deg == pytest.approx([pair[0] for pair in expected])
    assert direction_deg == pytest.approx([pair[1] for pair in expected])


def test_of_many_images_every_one_is_compared_with_equally_many_others() -> None:
    all_others = compared_images(7)
    assert all_others.tolist() == [[i for i in range(7) if i != j] for j in range(7)]
    few = compared_images(50, most_pairs=500)
    assert few.shape == (50, 10)
    assert (np.diff(few, axis=1) > 0).all()
    assert (few != np.arange(50)[:, None]).all()
    assert (np.bincount(few.ravel(), minlength=50) == 10).all()
    assert compared_images(1).shape == (1, 0)
    assert compared_images(0).shape == (0, 0)


def test_equal_centres_have_no_direction_in_the_reference_and_fail_in_the_model_only() -> None:
    rotations, _ = random_poses(3)
    reference = np.array([[0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0]])
    model = np.array([[0.0, 0, 0], [5.0, 0, 0], [5.0, 0, 0]])
    _, direction = relative_pose_errors(
        rotations,
        translation_of(rotations, model),
        rotations,
        translation_of(rotations, reference),
        min_baseline=1e-9,
    )
    # ordered pairs (j, i): (0,1) (0,2) (1,0) (1,2) (2,0) (2,1)
    assert direction == pytest.approx([0.0, 0.0, 0.0, 180.0, 0.0, 180.0], abs=1e-6)


def test_the_extent_of_a_model_is_that_of_its_registered_images() -> None:
    rotations, centers = random_poses(4)
    translations = translation_of(rotations, 1e-3 * centers + 5e6)
    complete = relative_pose_errors(rotations, translations, rotations, translation_of(rotations, centers))
    translations[0] = np.nan
    _, direction = relative_pose_errors(
        rotations, translations, rotations, translation_of(rotations, centers)
    )
    expected = complete[1].reshape(4, 3)
    expected[0], expected[1:, 0] = 180.0, 180.0
    assert direction.reshape(4, 3) == pytest.approx(expected, abs=1e-6)
    assert 0.0 <= direction.reshape(4, 3)[1:, 1:].max() < 1e-3


@pytest.mark.parametrize("count", [1, 2, 3, 20, 1000, 1001])
def test_alignment_recovers_any_similarity_also_for_few_cameras(count) -> None:
    rotations, centers = random_poses(count)
    model_rotations, model_centers, turn, _ = transformed(rotations, centers)
    found = align_poses(model_rotations, model_centers, rotations, centers)
    assert found.rotation == pytest.approx(turn.T, abs=1e-9)
    assert found.transform_points(model_centers) == pytest.approx(centers, abs=1e-8)
    assert found.transform_rotations(model_rotations) == pytest.approx(rotations, abs=1e-9)
    if count > 1:
        assert found.scale == pytest.approx(0.4)


def test_alignment_of_cameras_on_a_line_is_determined_by_their_rotations() -> None:
    rotations, _ = random_poses(8)
    centers = np.outer(np.arange(8.0), [1.0, 2.0, 3.0])
    model_rotations, model_centers, turn, _ = transformed(rotations, centers)
    found = align_poses(model_rotations, model_centers, rotations, centers)
    assert found.rotation == pytest.approx(turn.T, abs=1e-9)


def test_alignment_of_equal_centres_keeps_a_finite_scale() -> None:
    rotations, _ = random_poses(4)
    found = align_poses(rotations, np.zeros((4, 3)), rotations, np.ones((4, 3)))
    assert found.scale == 1.0
    assert found.translation == pytest.approx([1.0, 1.0, 1.0])


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45])
def test_a_wrong_minority_does_not_move_the_alignment(share) -> None:
    rng = np.random.default_rng(5)
    rotations, centers = random_poses(40)
    model_rotations, model_centers, _, _ = transformed(rotations, centers)
    wrong = rng.permutation(40)[: int(40 * share)]
    model_rotations[wrong] = exp_so3(rng.normal(size=(len(wrong), 3)) * 2) @ model_rotations[wrong]
    model_centers[wrong] += rng.normal(size=(len(wrong), 3)) * 40
    found = align_poses(model_rotations, model_centers, rotations, centers)
    right = np.setdiff1d(np.arange(40), wrong)
    assert np.abs(found.transform_points(model_centers[right]) - centers[right]).max() < 1e-3
    assert found.scale == pytest.approx(0.4, rel=1e-4)


def test_noisy_alignment_is_about_as_good_as_least_squares() -> None:
    rng = np.random.default_rng(2)
    rotations, centers = random_poses(60)
    model_rotations, model_centers, _, _ = transformed(rotations, centers)
    model_centers += rng.normal(0.0, 0.05, model_centers.shape)
    model_rotations = exp_so3(rng.normal(0.0, 0.01, (60, 3))) @ model_rotations
    found = align_poses(model_rotations, model_centers, rotations, centers)
    ours = np.sqrt(np.mean(np.sum((found.transform_points(model_centers) - centers) ** 2, axis=1)))
    reference = pycolmap.estimate_sim3d(model_centers, centers)
    fitted = np.array([reference * point for point in model_centers])
    best = np.sqrt(np.mean(np.sum((fitted - centers) ** 2, axis=1)))
    assert best <= ours < 1.05 * best
    assert 0.01 < ours < 0.06


def test_a_model_equal_to_its_reference_scores_everything() -> None:
    rotations, centers = random_poses(12)
    model_rotations, model_centers, _, _ = transformed(rotations, centers)
    result = evaluate_poses(named(model_rotations, model_centers), named(rotations, centers), **DEFAULTS)
    for name, value in result.metrics.items():
        if "auc" in name:
            assert value == pytest.approx(100.0, abs=1e-3), name
        elif "error" in name or "angle" in name:
            assert value == pytest.approx(0.0, abs=1e-5), name
    assert result.metrics["reference_images_registered"] == 12


def test_unregistered_images_count_as_failures_and_strangers_are_not_scored() -> None:
    rotations, centers = random_poses(10)
    model = named(rotations.copy(), centers.copy())
    model.rotations[0] = np.nan
    model.translations[0] = np.nan
    names = [*model.names[:9], "not there.jpg"]
    result = evaluate_poses(model, named(rotations, centers, names), **DEFAULTS)
    assert result.metrics["reference_images"] == 10
    assert result.metrics["reference_images_present"] == 9
    assert result.metrics["reference_images_registered"] == 8
    assert result.metrics["relative_pose_auc_5deg"] == pytest.approx(100.0 * 8 * 7 / 90, abs=1e-3)
    assert result.metrics["pose_auc_5deg"] == pytest.approx(80.0, abs=1e-3)
    assert result.metrics["rotation_error_deg_max"] == pytest.approx(0.0, abs=1e-6)
    assert np.isnan(result.rotation_deg[0])


@pytest.mark.parametrize(("name", "area"), [("001.jpg", 0.0), (None, 0.0), ("x.jpg", None)])
def test_a_model_without_any_scored_image_gets_zeros_and_nulls(name, area) -> None:
    rotations, centers = random_poses(4)
    names = [name] if name else []
    model = Poses(names, np.full((len(names), 3, 3), np.nan), np.full((len(names), 3), np.nan))
    metrics = evaluate_poses(model, named(rotations, centers), **DEFAULTS).metrics
    assert metrics["relative_pose_auc_1deg"] == area
    assert metrics["pose_auc_20deg"] == area
    assert metrics["position_error_median"] is None
    assert metrics["alignment_scale"] is None
    json.dumps(metrics, allow_nan=False)


@pytest.mark.parametrize(("present", "few"), [(0, True), (2, True), (3, False), (6, False)])
def test_few_names_in_common_are_said(present, few) -> None:
    rotations, centers = random_poses(6)
    names = [f"{k:03d}.jpg" if k < present else f"other {k}.jpg" for k in range(6)]
    said = evaluate_poses(
        named(rotations, centers, names), named(rotations, centers), **DEFAULTS
    ).few_present
    assert bool(said) == few and (not few or f"only {present} of the 6 images" in said)


def test_errors_of_images_have_the_names_of_the_model() -> None:
    rotations, centers = random_poses(4)
    model = named(rotations[:3], centers[:3], ["left/000.png", "001.jpg", "y.jpg"])
    found = evaluate_poses(model, named(rotations, centers), **DEFAULTS).per_image()
    names = {name: errors["reference_name"] for name, errors in found.items()}
    assert names == {"left/000.png": "000.jpg", "001.jpg": "001.jpg"} | {
        f"00{k}.jpg": f"00{k}.jpg" for k in (2, 3)
    }
    assert found["left/000.png"]["rotation_error_deg"] is not None
    assert found["003.jpg"]["rotation_error_deg"] is None


def test_known_noise_gives_known_errors() -> None:
    rng = np.random.default_rng(4)
    rotations, centers = random_poses(200)
    axes = rng.normal(size=(200, 3))
    axes *= np.radians(1.0) / np.linalg.norm(axes, axis=1, keepdims=True)
    metrics = evaluate_poses(
        named(exp_so3(axes) @ rotations, centers), named(rotations, centers), **DEFAULTS
    ).metrics
    assert 0.9 < metrics["rotation_error_deg_median"] < 1.1
    assert 1.2 < metrics["relative_rotation_error_deg_median"] < 1.6
    assert metrics["position_error_max"] < 0.2
    assert 40.0 < metrics["pose_auc_2.5deg"] < 70.0


def test_distribution_names_its_upper_end() -> None:
    assert _distribution("x", np.arange(11.0)) == {"x_median": 5, "x_mean": 5, "x_p90": 9, "x_max": 10}


def test_position_errors_are_percent_of_the_references_extent() -> None:
    rotations, _ = random_poses(4)
    centers = np.array([[0.0, 0, 0], [10.0, 0, 0], [0.0, 2, 0], [10.0, 2, 0]])
    shifted = centers + np.array([[0.0, 0, 0.1], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    metrics = evaluate_poses(named(rotations, shifted), named(rotations, centers), **DEFAULTS).metrics
    assert 0.5 < metrics["position_error_percent_max"] < 1.1
    assert metrics["position_error_percent_max"] == pytest.approx(
        100.0 * metrics["position_error_max"] / metrics["reference_extent"]
    )


def test_names_match_by_path_and_else_by_a_unique_file_name() -> None:
    names = ["a/1.jpg", "b/1.jpg", "c/2.jpg", "3.jpg"]
    assert match_names(names, ["a/1.jpg", "2.jpg", "1.jpg", "x/3.jpg", "y/4.jpg"]).tolist() == [
        0,
        2,
        -1,
        3,
        -1,
    ]
    assert match_names(["1.jpg"], ["a/1.jpg", "b/1.jpg"]).tolist() == [-1, -1]
    # no image is that of two, whichever of its names decides
    assert match_names(["a/1.jpg"], ["a/1.jpg", "1.jpg", "1.png"]).tolist() == [0, -1, -1]
    assert match_names(["a/1.jpg"], ["b/1.jpg", "c/1.png"]).tolist() == [0, -1]
    assert match_names(["a/1.jpg"], ["a/1.jpg", "b/1.jpg"]).tolist() == [0, -1]


def test_metrics_without_truth_count_and_weight_by_observations() -> None:
    metrics = model_metrics(np.array([True, True, False]), np.array([0, 2, 6]), np.array([1.0, 0.4]))
    assert metrics["registered_images"] == 2
    assert metrics["images"] == 3
    assert metrics["track_length_mean"] == 3.0
    assert metrics["reprojection_error_px_mean"] == pytest.approx(0.6)
    empty = model_metrics(np.zeros(2, bool), np.array([0]), np.zeros(0))
    assert empty["points"] == 0
    assert empty["track_length_mean"] is None


def test_a_real_reference_scores_against_itself_from_text_and_from_binary(data, tmp_path, capsys) -> None:
    reference = data / "strecha_fountain_p11" / "reference"
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    read_model(reference).write_binary(str(sparse))
    assert find_model(tmp_path) == sparse
    assert main([str(tmp_path), str(reference), "--per-image"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["registered_images"] == 11
    assert content["relative_pose_auc_1deg"] == pytest.approx(100.0, abs=1e-3)
    assert content["per_image"]["0000.jpg"]["position_error"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("stored_px", [-1.0, 7.0])
def test_reprojection_errors_are_computed_whatever_a_tool_stored(tmp_path, capsys, stored_px) -> None:
    made = make_problem(camera_count=6, point_count=200, noise_px=0.5)
    model = to_reconstruction(true_model(made), made.keypoints, [f"{k}.jpg" for k in range(6)])
    for point in model.points3D.values():
        point.error = stored_px
    model.write_binary(str(tmp_path))
    assert read_model(tmp_path).points3D[1].error == stored_px
    assert main([str(tmp_path), str(tmp_path)]) == 0
    content = json.loads(capsys.readouterr().out)
    # the length of a 2D Gaussian of 0.5 px has mean 0.5 sqrt(pi / 2)
    assert 0.59 < content["reprojection_error_px_mean"] < 0.66
    assert 0.5 < content["reprojection_error_px_median"] < 0.66
    metrics, evaluation = score_model(tmp_path, tmp_path)
    assert metrics == content and set(evaluation.metrics) < set(metrics)


def test_points_behind_a_camera_are_counted_and_have_no_error(tmp_path, capsys) -> None:
    made = make_problem(camera_count=6, point_count=200, noise_px=0.5)
    model = to_reconstruction(true_model(made), made.keypoints, [f"{k}.jpg" for k in range(6)])
    before = len(model.points3D)
    seen = max(model.points3D.values(), key=lambda point: point.track.length())
    images = [element.image_id for element in seen.track.elements]
    behind = model.image(images[0]).cam_from_world().inverse() * np.array([0.0, 0.0, -1.0])
    expected = sum(model.image(k).project_point(behind) is None for k in images)
    assert 0 < expected <= len(images)
    seen.xyz = behind
    model.write_binary(str(tmp_path))
    assert main([str(tmp_path), str(tmp_path)]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["observations_behind_camera"] == expected
    assert content["points"] == before and content["reprojection_error_px_mean"] < 1e4
    assert 0.5 < content["reprojection_error_px_median"] < 0.66


def test_a_folder_without_a_model_and_a_damaged_one_end_with_one_sentence(tmp_path, capsys) -> None:
    assert main([str(tmp_path), str(tmp_path)]) == 1
    assert "does not contain a COLMAP model" in capsys.readouterr().err
    for part in ("cameras", "images", "points3D"):
        (tmp_path / f"{part}.bin").write_bytes(b"\1\0\0\0\0\0\0\0nonsense")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_model(tmp_path)


def test_poses_of_a_model_are_those_that_were_put_in(data) -> None:
    poses = model_poses(read_model(data / "strecha_castle_p19" / "reference"))
    assert list(poses.names) == sorted(poses.names)
    assert np.allclose(poses.rotations @ np.swapaxes(poses.rotations, 1, 2), np.eye(3))
    problem = make_problem(camera_count=6, point_count=200)
    assert np.allclose(center_of(problem.rotations, problem.translations), problem.centers)
