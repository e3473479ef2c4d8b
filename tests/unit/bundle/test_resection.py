"""Poses of single images on a model that is there, with and without their focal length."""

from dataclasses import replace

import cv2  # noqa: F401
import numpy as np
import pycolmap
import pytest
from synthetic_scene import run_rounds, true_model

from snakesfm.bundle import rounds
from snakesfm.bundle.filtering import deregister_images_alone
from snakesfm.bundle.model import to_reconstruction
from snakesfm.bundle.resection import resect
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import angle_of
from snakesfm.synthetic.problems import make_problem

TRUE_FOCAL = 4000.0
NAMES = [f"{k}.jpg" for k in range(12)]
TURN = pycolmap.Rotation3d(np.array([0.1, -0.2, 0.05]))
POSE = pycolmap.Rigid3d(TURN, np.array([0.3, -0.2, 20.0]))


def seen_by_a_long_lens(count=200, outliers=60):
    """Keypoints (M,2) and points (M,3), the first ``outliers`` matched at random."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (count, 3)) * [1.2, 0.9, 4.0]
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=800, height=600, params=[TRUE_FOCAL, 400, 300])
    pixels = camera.img_from_cam(POSE * points) + rng.normal(0, 0.3, (count, 2))
    pixels[:outliers] = rng.uniform(0, [800, 600], (outliers, 2))
    return pixels, points


def guess(focal=900.0):
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=800, height=600, params=[focal, 400, 300, 0])


def test_the_focal_length_is_found_with_the_pose():
    camera = guess()
    found = resect(camera, *seen_by_a_long_lens(), 3.0, 15_000.0, 0)
    assert abs(found.camera.mean_focal_length() / TRUE_FOCAL - 1) < 0.02
    assert 138 <= found.support <= 143 and not found.inliers[:55].any()
    turned = found.pose.rotation.matrix().T @ TURN.matrix()
    assert np.degrees(angle_of(turned)) < 0.2
    assert camera.mean_focal_length() == 900.0


def test_a_camera_that_explains_the_matches_keeps_its_focal_length():
    found = resect(guess(1.01 * TRUE_FOCAL), *seen_by_a_long_lens(), 3.0, 15_000.0, 0)
    assert found.camera.mean_focal_length() == 1.01 * TRUE_FOCAL and found.support >= 138


@pytest.mark.parametrize(("factor", "focal"), [(1.1, 1.1 * TRUE_FOCAL), (1.12, TRUE_FOCAL)])
def test_another_focal_length_must_explain_a_fifth_more_matches(factor, focal):
    found = resect(guess(factor * TRUE_FOCAL), *seen_by_a_long_lens(), 3.0, 15_000.0, 0)
    assert found.camera.mean_focal_length() == pytest.approx(focal, rel=0.0 if factor == 1.1 else 0.02)


def test_without_a_longest_focal_length_the_cameras_stays():
    found = resect(guess(), *seen_by_a_long_lens(), 3.0, 0.0, 0)
    assert found.camera.mean_focal_length() == 900.0 and found.support < 110


def test_a_longer_lens_is_cut_to_the_longest_plausible_one():
    found = resect(guess(), *seen_by_a_long_lens(), 3.0, 3600.0, 0)
    assert found.camera.mean_focal_length() == pytest.approx(3600.0)
    assert 95 < found.support <= 138


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_matches_have_no_support(count):
    pixels, points = seen_by_a_long_lens(count=200, outliers=0)
    assert resect(guess(), pixels[:count], points[:count], 3.0, 15_000.0, 0).support <= 3


def own_cameras():
    """A problem whose images have a camera each, and its true model."""
    made = make_problem(12, 300, noise_px=0.3, seed=5)
    cameras = tuple(
        Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, 0.0), "estimated") for _ in range(12)
    )
    return made, replace(true_model(made), cameras=cameras, camera_ids=np.arange(12))


def adjusted(made, model):
    return run_rounds(made, model, refine_principal_points=False)


def test_an_image_that_leaves_in_the_last_pass_is_added_to_the_finished_model(monkeypatch):
    made, model = own_cameras()
    truly, records = adjusted(made, model)
    assert records[-1].name == "last pass"
    passes = []

    def wild_at_last(reconstruction, *_):
        passes.append(None)
        if len(passes) < 4:
            return {}
        reconstruction.camera(7).params = [120.0, 320.0, 240.0, 0.0]
        return {7: "focal length"}

    monkeypatch.setattr(rounds, "reset_wild_cameras", wild_at_last)
    found, records = adjusted(made, model)
    assert [record.name for record in records[-2:]] == ["last pass", "left-out images"]
    assert [(dict(record.wild), dict(record.held)) for record in records[-2:]] == [
        ({7: "focal length"}, {}),
        ({}, {}),
    ]
    assert found.registered.all()
    assert abs(found.cameras[6].focal_px / truly.cameras[6].focal_px - 1) < 0.02
    turned = found.rotations[6] @ found.rotations[0].T @ made.rotations[0] @ made.rotations[6].T
    assert np.degrees(angle_of(turned)) < 0.5
    seen = [np.count_nonzero(result.image_ids == 6) for result in (found, truly)]
    assert 15 <= seen[0] <= seen[1]


def test_a_long_lens_takes_no_part_in_the_last_pass():
    made, model = own_cameras()
    # what is long depends on the size of the image
    cameras = tuple(replace(c, width=32, height=24) if k == 6 else c for k, c in enumerate(model.cameras))
    found, records = adjusted(made, replace(model, cameras=cameras))
    assert [record.name for record in records[-2:]] == ["last pass", "left-out images"]
    assert [record.counts[0] for record in records[-3:]] == [12, 11, 12]
    assert abs(found.cameras[6].focal_px / 500.0 - 1) < 0.02


def test_only_images_that_share_their_camera_with_none_leave_with_it():
    made, model = own_cameras()
    model = replace(model, camera_ids=np.array([0, 1, 2, 2, *range(4, 12)]))
    reconstruction = to_reconstruction(model, made.keypoints, NAMES)
    assert deregister_images_alone(reconstruction, [2, 3]) == {2}
    assert set(reconstruction.reg_image_ids()) == set(range(1, 13)) - {2}


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL_FISHEYE", [500.0, 400.0, 300.0, 0.02]),
        ("RADIAL_FISHEYE", [500.0, 400.0, 300.0, 0.02, 0.001]),
        ("OPENCV_FISHEYE", [500.0, 500.0, 400.0, 300.0, 0.02, 0.0, 0.0, 0.0]),
        ("FOV", [500.0, 500.0, 400.0, 300.0, 0.5]),
        ("OPENCV", [500.0, 510.0, 400.0, 300.0, -0.1, 0.01, 0.0, 0.0]),
    ],
)
def test_every_camera_model_tells_matches_from_chance(model, params):
    camera = pycolmap.Camera(model=model, width=800, height=600, params=params)
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (120, 3)) * [6.0, 5.0, 4.0]
    pixels = camera.img_from_cam(POSE * points)
    pixels[:40] = rng.uniform(0, [800, 600], (40, 2))
    found = resect(camera, pixels, points, 2.0, 0.0, 0)
    assert 80 <= found.support <= 84 and found.inliers[40:].all()
    assert np.degrees(angle_of(found.pose.rotation.matrix().T @ TURN.matrix())) < 0.05
    strangers = resect(camera, rng.uniform(0, [800, 600], (120, 2)), points, 2.0, 0.0, 0)
    assert strangers.support < 15
