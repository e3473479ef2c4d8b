"""A model's place on the earth from positions in EXIF."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from snakesfm.evaluation.alignment import project_to_so3
from snakesfm.export.georeference import Georeference, downward_axes, georeference
from snakesfm.geometry.earth import local_origin
from snakesfm.geometry.poses import Similarity

ORIGIN = (47.0, 8.0, 500.0)
# columns: the camera's axes right, down and forward, in metres east, north and up
NADIR = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def place(centers, gps, origin, seed, rotations=None, orientations=None) -> Georeference | None:
    """The georeference by cameras whose world is turned as those of a model that GPS is for."""
    if rotations is None:
        downward = np.full((len(centers), 3), np.nan)
    else:
        ones = np.ones(len(centers), np.int32)
        downward = downward_axes(rotations, ones if orientations is None else orientations)
    return georeference(centers, downward, gps, origin, np.arange(len(centers)), seed)


def survey(count: int = 60, noise_m: float = 1.5, shape: tuple[float, ...] = (200.0, 100.0, 10.0)):
    """Camera centres (N,3) of a model, what GPS says of them, and the similarity between the two."""
    rng = np.random.default_rng(3)
    local = (rng.random((count, 3)) - 0.5) * shape
    turn = project_to_so3(rng.normal(size=(3, 3)))
    truth = Similarity(37.0, turn, np.array([5.0, -8.0, 3.0]))
    centers = (local - truth.translation) @ turn / truth.scale
    noisy = local + rng.normal(size=local.shape) * noise_m
    return centers, pycolmap.GPSTransform().enu_to_ellipsoid(noisy, *ORIGIN), truth


def test_the_similarity_is_found_among_wrong_positions():
    centers, gps, truth = survey()
    gps[:12, :2] += 0.01
    gps[12:15] = np.nan
    centers[15] = np.nan
    found = place(centers, gps, ORIGIN, 0)
    assert found.trusted and found.images == 56 and 36 <= found.inliers <= 44
    assert 1.0 < found.median_residual_m < 5.0
    move = found.local_from_model
    np.testing.assert_allclose(move.scale, truth.scale, rtol=0.01)
    np.testing.assert_allclose(move.rotation, truth.rotation, atol=0.03)
    np.testing.assert_allclose(move.translation, truth.translation, atol=1.5)


def test_good_positions_are_not_blurred_by_bad_ones():
    centers, gps, truth = survey(noise_m=0.02)
    gps[:6, 2] += 8.0
    move = place(centers, gps, ORIGIN, 0).local_from_model
    np.testing.assert_allclose(
        move.transform_points(centers),
        survey(noise_m=0.0)[0] @ (truth.scale * truth.rotation.T) + truth.translation,
        atol=0.05,
    )


@pytest.mark.parametrize(
    ("noise_m", "shape"), [(2.0, (5.0, 5.0, 1.0)), (0.5, (200.0, 0.5, 0.5)), (0.5, (0.0, 0.0, 0.0))]
)
def test_an_object_smaller_than_the_error_or_a_line_is_not_trusted(noise_m, shape):
    centers, gps, _ = survey(noise_m=noise_m, shape=shape)
    found = place(centers, gps, ORIGIN, 0)
    assert found is None or not found.trusted


@pytest.mark.parametrize("wrong", [[0.0, 0.0, -281.0], [0.0, 3000.0, 0.0], [900.0, 400.0, 100.0]])
@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_position_beside_a_line_does_not_make_it_an_area(seed, wrong):
    rng = np.random.default_rng(seed)
    for width_m, trusted in ((0.0, False), (60.0, True)):
        local = np.zeros((20, 3))
        local[:, 0], local[1::2, 1] = 20.0 * np.arange(20), width_m
        centers = 0.1 * local @ project_to_so3(rng.normal(size=(3, 3))) + rng.normal(size=(20, 3)) * 0.002
        noisy = local + rng.normal(size=(20, 3)) * 1.5
        noisy[7] += wrong
        gps = pycolmap.GPSTransform().enu_to_ellipsoid(noisy, *ORIGIN)
        found = place(centers, gps, local_origin(gps), 0)
        assert found.trusted == trusted
        assert found.inliers == 19
        assert 1.0 < found.median_residual_m < 3.5
        assert 90.0 < found.spread_m[0] < 140.0
        assert width_m / 3 <= found.spread_m[1] < width_m / 2 + 5.0


def test_few_positions_tell_nothing():
    centers, gps, _ = survey()
    gps[3:] = np.nan
    assert place(centers, gps, ORIGIN, 0) is None
    assert local_origin(np.full((4, 3), np.nan)) is None


def test_the_origin_is_the_middle_and_the_result_is_that_of_the_seed():
    centers, gps, _ = survey()
    assert np.all(np.abs(np.array(local_origin(gps)) - ORIGIN) < (1e-3, 1e-3, 5.0))
    for east in (170.0, 180.0, -180.0, 359.0):
        moved = np.array(gps)
        moved[:, 1] = (gps[:, 1] - ORIGIN[1] + east + 180.0) % 360.0 - 180.0
        off = (local_origin(moved)[1] - east + 180.0) % 360.0 - 180.0
        assert abs(off) < 1e-3
        assert -180.0 <= local_origin(moved)[1] < 180.0
    first, second = (place(centers, gps, ORIGIN, 7).local_from_model for _ in range(2))
    np.testing.assert_array_equal(first.rotation, second.rotation)
    assert first.scale == second.scale


def test_positions_that_agree_with_nothing_are_no_inliers():
    centers, gps, _ = survey(count=12)
    gps[6:] += [-30.0, 60.0, 0.0]
    found = place(centers, gps, ORIGIN, 0)
    # six of them agree with each other, all twelve with nothing
    assert found is None or (found.inliers <= 6 and found.median_residual_m < 20.0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", ["nadir", "oblique", "level", "rolled"])
def test_positions_in_the_wrong_hemisphere_do_not_turn_a_model_upside_down(kind, seed):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(25.0 * np.arange(9), 30.0 * np.arange(7))
    local = np.column_stack([x.ravel(), y.ravel(), np.zeros(63)]) + rng.normal(size=(63, 3)) * 0.5
    turn = project_to_so3(rng.normal(size=(3, 3)))
    tilt = Rotation.from_euler("x", -40.0, degrees=True).as_matrix()
    camera = {"nadir": NADIR, "oblique": LEVEL @ tilt, "level": LEVEL, "rolled": LEVEL}[kind]
    # stored with the upper side below, to the left or to the right
    orientations = rng.choice([3, 6, 8], 63) if kind == "rolled" else np.ones(63, np.int32)
    rolls = np.select([orientations == 3, orientations == 6, orientations == 8], [180.0, 90.0, -90.0])
    # flights go to and fro, and people turn about
    yaw = Rotation.from_euler("z", rng.choice([0.0, 180.0], (63, 1)), degrees=True).as_matrix()
    roll = Rotation.from_euler("z", rolls[:, None], degrees=True).as_matrix()
    shake = Rotation.from_rotvec(rng.normal(size=(63, 3)) * 0.05).as_matrix()
    world_from_cam = yaw @ camera @ roll @ shake
    # cam_from_model, of a model that is turned and ten times as small
    rotations = world_from_cam.transpose(0, 2, 1) @ turn
    centers = 0.1 * local @ turn
    gps = pycolmap.GPSTransform().enu_to_ellipsoid(local + rng.normal(size=(63, 3)) * 0.5, *ORIGIN)
    right = place(centers, gps, local_origin(gps), 0, rotations, orientations)
    assert right.trusted and right.inliers >= 60 and -1.5 < right.upward < -0.8
    for column in (0, 1):
        mirrored = np.array(gps)
        mirrored[:, column] *= -1.0
        wrong = place(centers, mirrored, local_origin(mirrored), 0, rotations, orientations)
        assert wrong.inliers >= 60 and 0.8 < wrong.upward < 1.5
        assert not wrong.trusted and "GPSLongitudeRef" in wrong.refusal


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("scattered", [True, False])
def test_a_majority_of_good_positions_is_told_from_a_receiver_that_froze(scattered, seed):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(25.0 * np.arange(10), 30.0 * np.arange(8))
    local = np.column_stack([x.ravel(), y.ravel(), np.zeros(80)]) + rng.normal(size=(80, 3)) * 0.3
    turn = project_to_so3(rng.normal(size=(3, 3)))
    noisy = local + rng.normal(size=local.shape) * 0.5
    # towards the end, the good positions cover only a part
    frozen = rng.permutation(80)[:30] if scattered else np.arange(50, 80)
    noisy[frozen] = noisy[frozen[0]]
    gps = pycolmap.GPSTransform().enu_to_ellipsoid(noisy, *ORIGIN)
    found = place(0.1 * local @ turn, gps, local_origin(gps), 0)
    assert found.trusted and 49 <= found.inliers <= 53
    assert 0.4 < found.median_residual_m < 1.5
    np.testing.assert_allclose(found.local_from_model.rotation @ turn.T, np.eye(3), atol=0.02)
    np.testing.assert_allclose(found.local_from_model.scale, 10.0, rtol=0.01)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("relief_m", [0.0, 15.0])
def test_cameras_upside_down_are_told_from_positions_in_the_wrong_hemisphere(relief_m, seed):
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, 120)
    local = np.column_stack([150.0 * np.cos(angle), 100.0 * np.sin(angle), relief_m * np.sin(3.0 * angle)])
    local += rng.normal(size=local.shape) * 0.1
    turn = project_to_so3(rng.normal(size=(3, 3)))

    def found(mirror: list[float], camera: np.ndarray) -> Georeference:
        noisy = local * mirror + rng.normal(size=local.shape) * 0.3
        gps = pycolmap.GPSTransform().enu_to_ellipsoid(noisy, *ORIGIN)
        rotations = np.repeat((camera.T @ turn)[None], 120, axis=0)
        return place(0.1 * local @ turn, gps, local_origin(gps), 0, rotations)

    inverted = found([1.0, 1.0, 1.0], LEVEL @ np.diag([-1.0, -1.0, 1.0]))
    assert inverted.inliers >= 115 and inverted.upward > 0.9
    if relief_m:
        assert inverted.trusted and 3.0 < inverted.mirrored_ratio < 100.0
        (sentence,) = inverted.warnings([])
        assert "mounted upside down" in sentence
    else:
        assert 0.7 < inverted.mirrored_ratio < 1.4 and inverted.warnings([]) == []
        assert "GPSLongitudeRef" in inverted.refusal and "set georeference: true" in inverted.refusal
    for mirror in ([-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]):
        wrong = found(mirror, LEVEL)
        assert "GPSLongitudeRef" in wrong.refusal
        assert ("georeference: true" in wrong.refusal) == (relief_m == 0.0)
        assert (wrong.mirrored_ratio < 0.5) == (relief_m > 0.0) and wrong.mirrored_ratio < 1.4
    right = found([1.0, 1.0, 1.0], LEVEL)
    assert right.trusted and right.warnings([]) == []


@pytest.mark.parametrize(("frozen", "warned"), [(0, False), (16, False), (30, True)])
def test_a_model_placed_by_few_of_the_positions_is_told(frozen, warned):
    centers, gps, _ = survey(count=80, noise_m=0.5)
    gps[:frozen] = gps[0]
    found = place(centers, gps, local_origin(gps), 0)
    assert found.trusted and 78 - frozen <= found.inliers <= 81 - frozen
    assert [f"Only {found.inliers} of 80" in line for line in found.warnings([])] == [True] * warned
