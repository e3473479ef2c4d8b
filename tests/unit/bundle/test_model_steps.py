"""The model to pycolmap and back, and what is done to it between rounds."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pycolmap
import pytest
import synthetic_scene
from synthetic_scene import graph_of, run_rounds

from snakesfm.bundle import rounds
from snakesfm.bundle.completion import complete_tracks, drop_repeated_observations
from snakesfm.bundle.filtering import deregister_weak_images, drop_short_tracks, filter_observations
from snakesfm.bundle.interface import SolverSettings
from snakesfm.bundle.model import BundleModel, from_reconstruction, reprojection_errors, to_reconstruction
from snakesfm.bundle.registration import register_left_out
from snakesfm.bundle.rounds import bundle_adjuster, keypoint_noise_px
from snakesfm.geometry.poses import to_rigid3d, translation_of
from snakesfm.geometry.rotations import angle_of
from snakesfm.synthetic.problems import make_problem, perturb_rotations

SEEN = 24
NAMES = [f"{k}.jpg" for k in range(12)]


def problem(**changes):
    return make_problem(12, 300, **{"noise_px": 0.3, "seed": 5, **changes})


def model_of(made, left_out=(), keep=None):
    """The true model, without the poses of ``left_out`` and with the observations ``keep`` only."""
    rotations, translations = made.rotations.copy(), made.translations.copy()
    rotations[list(left_out)] = np.nan
    translations[list(left_out)] = np.nan
    keep = np.ones(len(made.track_image_ids), bool) if keep is None else keep
    track_of = np.repeat(np.arange(len(made.points)), np.diff(made.track_offsets))
    lengths = np.bincount(track_of[keep], minlength=len(made.points))
    return BundleModel(
        made.cameras,
        made.camera_ids,
        rotations,
        translations,
        made.points,
        np.r_[0, np.cumsum(lengths)],
        made.track_image_ids[keep],
        made.track_keypoint_ids[keep],
    )


def errors_px(model, made):
    base = np.r_[0, np.cumsum([len(k) for k in made.keypoints])]
    return reprojection_errors(
        model, np.concatenate(made.keypoints)[base[model.image_ids] + model.keypoint_ids]
    )


def test_round_trip_keeps_everything_and_sorts():
    made = problem()
    model = model_of(made, left_out=[3])
    result, pixels = from_reconstruction(to_reconstruction(model, made.keypoints, NAMES), model)
    expected = [made.keypoints[i][k] for i, k in zip(result.image_ids, result.keypoint_ids, strict=True)]
    np.testing.assert_array_equal(pixels, expected)
    assert np.isnan(result.rotations[3]).all() and not (result.image_ids == 3).any()
    posed = np.arange(12) != 3
    np.testing.assert_allclose(result.rotations[posed], model.rotations[posed], atol=1e-12)
    np.testing.assert_allclose(result.translations[posed], model.translations[posed], atol=1e-12)
    assert result.offsets[-1] == len(result.image_ids)
    first = list(
        zip(result.image_ids[result.offsets[:-1]], result.keypoint_ids[result.offsets[:-1]], strict=True)
    )
    assert first == sorted(first)
    for a, b in zip(result.offsets[:-1], result.offsets[1:], strict=True):
        assert b - a >= 2 and np.all(np.diff(result.image_ids[a:b]) > 0)
    assert 0.2 < errors_px(result, made).mean() < 0.6
    again, _ = from_reconstruction(to_reconstruction(result, made.keypoints, NAMES), result)
    np.testing.assert_array_equal(again.points, result.points)
    np.testing.assert_array_equal(again.keypoint_ids, result.keypoint_ids)


def test_pycolmaps_model_is_that_of_single_objects():
    made = problem()
    model = model_of(made, left_out=[3, 7])
    taking_part = np.arange(12) != 7
    found = to_reconstruction(model, made.keypoints, NAMES, taking_part)
    expected = pycolmap.Reconstruction()
    expected.add_camera_with_trivial_rig(made.cameras[0].to_pycolmap(1))
    for row in np.flatnonzero(taking_part).tolist():
        image = pycolmap.Image(
            name=NAMES[row], camera_id=1, image_id=row + 1, keypoints=made.keypoints[row].astype(float)
        )
        pose = [to_rigid3d(model.rotations[row], model.translations[row])] if row != 3 else []
        expected.add_image_with_trivial_frame(image, *pose)
    for point, start, end in zip(model.points, model.offsets[:-1], model.offsets[1:], strict=True):
        seen = [k for k in range(start, end) if model.image_ids[k] not in (3, 7)]
        track = [pycolmap.TrackElement(model.image_ids[k] + 1, model.keypoint_ids[k]) for k in seen]
        if len(track) >= 2:
            expected.add_point3D(point, pycolmap.Track(track))
    assert len(model.points) > found.num_points3D() > 100
    # the order in which pycolmap goes through points decides what is merged first
    assert list(found.points3D) == list(expected.points3D)
    assert found.reg_image_ids() == expected.reg_image_ids() == [1, 2, 3, 5, 6, 7, 9, 10, 11, 12]
    for name in ("points3D", "images", "frames", "cameras"):
        there, wanted = getattr(found, name), getattr(expected, name)
        assert sorted(there) == sorted(wanted)
        assert {key: repr(value.todict()) for key, value in there.items()} == {
            key: repr(value.todict()) for key, value in wanted.items()
        }


def test_empty_model():
    made = problem()
    model = model_of(made, left_out=range(12))
    result, _ = from_reconstruction(to_reconstruction(model, made.keypoints, NAMES), model)
    assert result.points.shape == (0, 3) and result.offsets.tolist() == [0]
    assert errors_px(result, made).shape == (0,)


def test_points_behind_the_camera_have_infinite_errors():
    made = problem()
    model = model_of(made)
    assert np.isinf(errors_px(replace(model, translations=model.translations - [0, 0, 1e3]), made)).all()


@pytest.mark.parametrize("noise_px", [0.3, 1.0])
def test_noise_of_keypoints_allows_for_what_points_take_up(noise_px):
    made = problem(noise_px=noise_px)
    reconstruction = to_reconstruction(model_of(made), made.keypoints, NAMES)
    bundle_adjuster("ceres")(
        reconstruction, SolverSettings(loss="squared", constant_cameras=frozenset(reconstruction.cameras))
    )
    assert 0.78 < keypoint_noise_px(reconstruction) / noise_px < 1.02


def test_filter_drops_observations_and_not_whole_tracks():
    made = problem(outlier_ratio=0.05)
    model = model_of(made)
    reconstruction = to_reconstruction(model, made.keypoints, NAMES)
    filter_observations(reconstruction, 4.0, 0.0)
    result, _ = from_reconstruction(reconstruction, model)
    assert errors_px(result, made).max() <= 4.0
    dropped = len(model.image_ids) - len(result.image_ids)
    assert made.track_outliers.sum() * 0.9 < dropped < made.track_outliers.sum() * 1.6
    filter_observations(reconstruction, 4.0, 0.0, 3)
    assert np.diff(from_reconstruction(reconstruction, model)[0].offsets).min() == 3
    drop_short_tracks(reconstruction, 4)
    assert np.diff(from_reconstruction(reconstruction, model)[0].offsets).min() == 4


def test_images_of_few_long_tracks_keep_their_short_ones():
    made = problem()
    lengths = np.diff(made.track_offsets)
    track_of = np.repeat(np.arange(len(lengths)), lengths)
    # of the tracks of the first image only two observations stay, one of them its own
    mine = np.zeros(len(lengths), bool)
    mine[track_of[made.track_image_ids == 0]] = True
    place = np.arange(len(track_of)) - made.track_offsets[:-1][track_of]
    model = model_of(made, keep=~mine[track_of] | (place < 2))
    counts = []
    for sparse_observations in (0, 1, 10_000):
        reconstruction = to_reconstruction(model, made.keypoints, NAMES)
        drop_short_tracks(reconstruction, 3, sparse_observations)
        counts.append((reconstruction.image(1).num_points3D, reconstruction.num_points3D()))
    assert counts[0] == (0, (lengths[~mine] >= 3).sum())
    assert counts[1] == (mine.sum(), (lengths[~mine] >= 3).sum() + mine.sum())
    assert counts[2] == (mine.sum(), len(lengths))


def test_weak_images_are_taken_out():
    made = problem()
    few = np.ones(len(made.track_image_ids), bool)
    few[np.nonzero(made.track_image_ids == 2)[0][5:]] = False
    reconstruction = to_reconstruction(model_of(made, keep=few), made.keypoints, NAMES)
    deregister_weak_images(reconstruction, 10)
    assert sorted(reconstruction.reg_image_ids()) == [k + 1 for k in range(12) if k != 2]


@pytest.mark.parametrize("min_angle_deg", [1.0, 0.0])
def test_completion_brings_observations_back(min_angle_deg):
    made = problem()
    rng = np.random.default_rng(0)
    half = rng.random(len(made.track_image_ids)) < 0.5
    model = model_of(made, keep=half)
    reconstruction = to_reconstruction(model, made.keypoints, NAMES)
    drop_short_tracks(reconstruction, 2)
    before = reconstruction.compute_num_observations()
    complete_tracks(reconstruction, graph_of(made), 4.0, min_angle_deg, 0)
    result, _ = from_reconstruction(reconstruction, model)
    assert 0.3 * len(half) < len(result.image_ids) - before < len(half)
    assert errors_px(result, made).max() < 6.0


@pytest.mark.parametrize(("max_error_px", "merged"), [(0.5, False), (8.0, True)])
def test_points_are_merged_where_all_observations_fit(max_error_px, merged):
    made = problem(noise_px=1.0)
    model = model_of(made)
    lengths = np.diff(made.track_offsets)
    # every track of four or more observations is two points
    starts = made.track_offsets[:-1]
    halved = lengths >= 4
    offsets = np.unique(np.r_[made.track_offsets, starts[halved] + lengths[halved] // 2])
    points = np.repeat(made.points, 1 + halved, axis=0)
    reconstruction = to_reconstruction(
        replace(model, points=points, offsets=offsets), made.keypoints, NAMES
    )
    assert reconstruction.num_points3D() == len(points) > len(made.points) + 50
    complete_tracks(reconstruction, graph_of(made), max_error_px, 1.0, 0, [])
    left = (reconstruction.num_points3D() - len(made.points)) / halved.sum()
    assert left < 0.05 if merged else left > 0.95


def test_an_image_observes_a_point_once():
    made = problem()
    model = model_of(made)
    reconstruction = to_reconstruction(model, made.keypoints, NAMES)
    point = min(reconstruction.point3D_ids())
    image = reconstruction.point3D(point).track.elements[0].image_id
    others = [
        e for p in sorted(reconstruction.point3D_ids()) for e in reconstruction.point3D(p).track.elements
    ]
    row = next(e.point2D_idx for e in others[::-1] if e.image_id == image)
    reconstruction.delete_observation(image, row)
    before = reconstruction.compute_num_observations()
    reconstruction.add_observation(point, pycolmap.TrackElement(image, row))
    for _ in range(2):
        drop_repeated_observations(reconstruction)
        assert reconstruction.compute_num_observations() == before


def test_left_out_image_is_registered_and_a_stranger_is_not():
    made = problem()
    reconstruction = to_reconstruction(model_of(made, left_out=[4, 7]), made.keypoints, NAMES)
    strange = made.matches.copy()
    rng = np.random.default_rng(0)
    pair_of = np.repeat(np.arange(len(made.pairs)), np.diff(made.match_offsets))
    for side in (0, 1):
        rows = made.pairs[pair_of, side] == 7
        strange[rows, side] = rng.integers(0, len(made.keypoints[7]), rows.sum())
    graph = graph_of(made, strange)
    assert register_left_out(reconstruction, graph, 6.0, 15, 0.25, {}, 0) == [4]
    pose = reconstruction.image(5).cam_from_world()
    assert np.degrees(angle_of(pose.rotation.matrix().T @ made.rotations[4])) < 0.3
    assert np.linalg.norm(pose.inverse().translation - made.centers[4]) < 0.05
    assert reconstruction.image(5).num_points3D >= 15


def perturbed(made, left_out=()):
    model = model_of(made, left_out)
    rng = np.random.default_rng(3)
    centers = made.centers + rng.normal(0, 0.02, made.centers.shape)
    rotations = perturb_rotations(model.rotations, 0.5, 1) if not left_out else model.rotations
    return replace(
        model,
        rotations=rotations,
        translations=np.where(
            np.isnan(model.translations), np.nan, translation_of(np.nan_to_num(rotations), centers)
        ),
        points=made.points + rng.normal(0, 0.03, made.points.shape),
    )


def adjusted(made, model, **changes):
    """As :func:`run_rounds`, with the intrinsics held."""
    return run_rounds(made, model, SolverSettings(constant_cameras=frozenset([1])), **changes)


def test_rounds_are_chained_and_recover_the_truth():
    made = problem(outlier_ratio=0.05)
    result, records = adjusted(made, perturbed(made))
    names = [record.name for record in records]
    assert names == ["round 1", "round 2", "round 3", "last pass"]
    assert records[0].costs[0] > 5 * records[1].costs[1]
    for record in records:
        assert record.costs[1] <= record.costs[0]
    errors = np.degrees(
        angle_of(
            np.einsum(
                "nij,nkj->nik",
                result.rotations @ result.rotations[0].T,
                made.rotations @ made.rotations[0].T,
            )[1:]
        )
    )
    assert 1e-3 < errors.mean() < 0.3
    assert 0.2 < errors_px(result, made).mean() < 0.6 and errors_px(result, made).max() <= 3.0
    assert records[-1].counts == (12, len(result.points), len(result.image_ids))


def test_left_out_images_get_a_last_round():
    made = problem()
    result, records = adjusted(made, perturbed(made, left_out=[6]))
    assert [record.name for record in records[-2:]] == ["registration", "last pass"]
    assert records[-1].counts[0] == 12
    assert np.isfinite(result.rotations).all()
    stays, _ = adjusted(made, perturbed(made, left_out=[6]), register_images=False)
    assert np.isnan(stays.rotations[6]).all()


@pytest.mark.parametrize(("share", "rounds_of_registration"), [(0.05, 2), (0.2, 1)])
def test_few_images_are_registered_after_others_without_a_pass(monkeypatch, share, rounds_of_registration):
    monkeypatch.setattr(rounds, "PASS_SHARE", share)
    graphs = []
    monkeypatch.setattr(synthetic_scene, "graph_of", lambda made: graphs.append(1) or graph_of(made))
    made = problem()
    # image 7 has matches with image 6 alone
    kept = (made.pairs != 7).all(axis=1) | (made.pairs == [6, 7]).all(axis=1)
    lengths = np.diff(made.match_offsets)
    made = replace(
        made,
        pairs=made.pairs[kept],
        matches=made.matches[np.repeat(kept, lengths)],
        match_offsets=np.r_[0, np.cumsum(lengths[kept])],
    )
    result, records = adjusted(made, perturbed(made, left_out=[6, 7]))
    names = [record.name for record in records]
    assert names == [
        "round 1",
        "round 2",
        "round 3",
        *["registration"] * rounds_of_registration,
        "last pass",
    ]
    assert np.isfinite(result.rotations).all()
    # it is kept as long as images are left out
    assert len(graphs) == 1


def test_an_image_that_is_thrown_out_again_is_registered_once():
    made = problem()
    side = np.repeat(made.pairs, np.diff(made.match_offsets), axis=0)
    few = ((side != 6) | (made.matches < SEEN)).all(axis=1)
    pair_of = np.repeat(np.arange(len(made.pairs)), np.diff(made.match_offsets))
    counts = np.bincount(pair_of[few], minlength=len(made.pairs))
    made = replace(made, matches=made.matches[few], match_offsets=np.r_[0, np.cumsum(counts)])
    limits = {"register_min_inliers": 6, "min_observations": SEEN}
    result, records = adjusted(made, perturbed(made, left_out=[6]), **limits)
    assert [record.name for record in records].count("registration") == 1
    assert np.isnan(result.rotations[6]).all() and 10 <= records[-1].counts[0] <= 11
