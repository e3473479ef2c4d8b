"""Observations aligned in rendered images of a textured plane, whose keypoints are known exactly."""

import functools

import cv2
import numpy as np
import pytest

from snakesfm.bundle.alignment import (
    AlignmentSettings,
    GrayImage,
    align_observations,
    choose_templates,
)
from snakesfm.bundle.image_sources import ImageSource
from snakesfm.bundle.keypoint_refinement import most_share_a_camera, refine_by_sources, refine_keypoints
from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.bundle.reading import read_tracks, read_tracks_and_pixels
from snakesfm.bundle.sharpness import find_blurred
from snakesfm.geometry.camera import Camera
from snakesfm.geometry.rotations import exp_so3

SETTINGS = AlignmentSettings()
TEXTURE_PX_PER_UNIT = 100.0
CAMERA = Camera("SIMPLE_RADIAL", 400, 300, (400.0, 200.0, 150.0, 0.0))


def texture(seed: int, height: int = 900, width: int = 1200) -> np.ndarray:
    """Random gray values with structures of some pixels."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), 2.5)
    return np.clip(128 + 400 * noise, 0, 255).astype(np.uint8)


def camera_matrix() -> np.ndarray:
    focal, x, y, _ = CAMERA.params
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def plane_to_image(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Homography from the plane z = 0 of the world to pixels."""
    return camera_matrix() @ np.column_stack([rotation[:, 0], rotation[:, 1], translation])


def render(look: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """The texture, whose first pixel is at the plane's (-6, -4.5), in an image; centres are at one half."""
    to_plane = np.array([[1, 0, -600.0], [0, 1, -450.0], [0, 0, TEXTURE_PX_PER_UNIT]]) / TEXTURE_PX_PER_UNIT
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    warp = np.linalg.inv(half) @ homography @ to_plane @ half
    return cv2.warpPerspective(look, warp, (400, 300), flags=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def scene():
    """Five views of the plane, of different brightness, and where 150 of its points are in them."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-1.2, 1.2, (150, 2)), np.zeros(150)])
    look, images, poses, pixels = texture(0), [], [], []
    for k in range(5):
        rotation = exp_so3(np.array([0.08 * (k - 2), 0.12 * (k - 2), 0.2 * k]))
        translation = np.array([0.1 * k - 0.2, 0.05 * k, 4.0 + 0.2 * k])
        images.append(
            np.clip(render(look, plane_to_image(rotation, translation)) * (0.6 + 0.1 * k), 0, 255)
        )
        poses.append((rotation, translation))
        seen = points @ rotation.T + translation
        pixels.append(400.0 * seen[:, :2] / seen[:, 2:] + np.array([200.0, 150.0]))
    return points, [image.astype(np.uint8) for image in images], poses, np.array(pixels)


@pytest.mark.parametrize("threads", [1, 2])
def test_images_of_a_sequence_are_read_once_however_many_there_are(threads: int) -> None:
    count, length = 100, 6
    look = texture(3, 60, 80)

    @functools.lru_cache(maxsize=48)
    def read_gray(image: int) -> GrayImage:
        return GrayImage(look, np.ones(2))

    starts = np.repeat(np.arange(count - length), length)
    images = starts + np.tile(np.arange(length), count - length)
    pixels = np.tile([40.2, 30.3], (len(images), 1))
    # the template of a track is its last image for some, its first for others
    templates = np.repeat(np.arange(count - length) * length + np.arange(count - length) % 2 * 5, length)
    tangents, inside = np.tile(np.eye(2), (len(images), 1, 1)), np.ones(len(images), bool)
    moved, aligned = align_observations(
        read_gray, images, pixels, tangents, templates, inside, AlignmentSettings(threads=threads)
    )
    assert aligned.all()
    np.testing.assert_allclose(moved, pixels, atol=0.01)
    assert count - 1 <= read_gray.cache_info().misses <= count + 2


def model_of(scene, noise_px: float):
    """The true model with noisy keypoints, as a reconstruction."""
    points, _, poses, pixels = scene
    rng = np.random.default_rng(2)
    keypoints = [p + rng.normal(0, noise_px, p.shape) for p in pixels]
    count = len(points)
    model = BundleModel(
        (CAMERA,),
        np.zeros(5, np.int32),
        np.array([rotation for rotation, _ in poses]),
        np.array([translation for _, translation in poses]),
        points,
        np.arange(count + 1) * 5,
        np.tile(np.arange(5, dtype=np.int32), count),
        np.repeat(np.arange(count, dtype=np.int32), 5),
    )
    return to_reconstruction(model, keypoints, [f"{k}.jpg" for k in range(5)])


def spread_px(reconstruction, pixels: np.ndarray, without: int = -1) -> np.ndarray:
    """How far (L,) the keypoints of a point are from their true places, up to what all of them share."""
    tracks, places = read_tracks_and_pixels(reconstruction)
    counted = tracks.images != without
    offsets = (places - pixels[tracks.images, tracks.rows])[counted]
    point_of = tracks.point_rows[counted]
    sums = np.zeros((len(tracks.points), 2))
    np.add.at(sums, point_of, offsets)
    return np.linalg.norm(offsets - (sums / np.bincount(point_of)[:, None])[point_of], axis=1)


def read(images, scale: float = 1.0):
    def read_gray(row):
        if images[row] is None:
            return None
        size = (round(400 / scale), round(300 / scale))
        gray = cv2.resize(images[row], size, interpolation=cv2.INTER_AREA) if scale > 1 else images[row]
        return GrayImage(gray, np.array([scale, scale]))

    return read_gray


@pytest.mark.parametrize(("scale", "least", "most"), [(1.0, 0.001, 0.12), (2.0, 0.001, 0.25)])
def test_keypoints_of_a_point_come_to_agree(scene, scale, least, most):
    reconstruction = model_of(scene, 0.35)
    before = np.median(spread_px(reconstruction, scene[3]))
    assert 0.3 < before < 0.5
    scales = np.full(5, scale)
    aligned, count = refine_keypoints(reconstruction, read(scene[1], scale), scales, SETTINGS)
    assert 0.9 * count < aligned <= count == 750
    after = np.median(spread_px(reconstruction, scene[3]))
    assert least < after < most


def disagreement_px(reconstruction, poses) -> float:
    """How far the keypoints of a point are from each other on the plane, median in its texture's pixels."""
    tracks, pixels = read_tracks_and_pixels(reconstruction)
    point_of = tracks.point_rows
    to_plane = np.array([np.linalg.inv(plane_to_image(*pose)) for pose in poses])
    places = np.einsum(
        "lij,lj->li", to_plane[tracks.images], np.column_stack([pixels, np.ones(len(pixels))])
    )
    places = TEXTURE_PX_PER_UNIT * places[:, :2] / places[:, 2:]
    sums = np.zeros((len(tracks.points), 2))
    np.add.at(sums, point_of, places)
    means = sums / np.bincount(point_of)[:, None]
    return float(np.median(np.linalg.norm(places - means[point_of], axis=1)))


def test_finer_images_bring_keypoints_closer_together(scene):
    reconstruction = model_of(scene, 0.7)
    found = [disagreement_px(reconstruction, scene[2])]
    for scale, radius in ((4.0, 5), (2.0, 8), (1.0, 13)):
        settings = AlignmentSettings(radius)
        refine_keypoints(reconstruction, read(scene[1], scale), np.full(5, scale), settings)
        found.append(disagreement_px(reconstruction, scene[2]))
    start, coarse, fine, finest = found
    assert 0.5 < start < 1.2
    assert 0.04 < coarse < 0.08
    assert fine < 0.8 * coarse
    assert 0.01 < finest < 0.8 * fine


def test_an_observation_of_something_else_is_dropped_and_an_image_of_another_look_is_not(scene):
    images = [image.copy() for image in scene[1]]
    other = texture(9)[:300, :400]
    images[1][:, :100] = other[:, :100]
    images[4] = other
    reconstruction = model_of(scene, 0.2)
    refine_keypoints(reconstruction, read(images), np.ones(5), SETTINGS)
    tracks = read_tracks(reconstruction)
    owners, rows = tracks.images, tracks.rows
    hidden = scene[3][1][:, 0] < 90
    kept = np.isin(np.arange(150), rows[owners == 1])
    assert hidden.sum() > 5
    assert kept[hidden].mean() < 0.1
    assert kept[scene[3][1][:, 0] > 110].mean() > 0.9
    # nothing in the fifth image looks like the others: it keeps its keypoints where they were
    assert (owners == 4).sum() == 150


def test_images_that_cannot_be_read_keep_their_keypoints(scene):
    reconstruction = model_of(scene, 0.2)
    before = [reconstruction.image(3).point2D(k).xy.copy() for k in range(150)]
    refine_keypoints(reconstruction, read([*scene[1][:2], None, *scene[1][3:]]), np.ones(5), SETTINGS)
    np.testing.assert_array_equal(before, [reconstruction.image(3).point2D(k).xy for k in range(150)])
    assert reconstruction.image(3).num_points3D == 150


def test_an_image_in_which_nothing_can_be_aligned_keeps_its_keypoints(scene):
    points, images, poses, pixels = scene
    noise = np.random.default_rng(0).integers(0, 255, images[2].shape).astype(np.uint8)
    for point in range(8):
        one = (points[point : point + 1], images, poses, pixels[:, point : point + 1])
        reconstruction = model_of(one, 0.35)
        before = reconstruction.image(3).point2D(0).xy.copy()
        aligned, count = refine_keypoints(
            reconstruction, read([*images[:2], noise, *images[3:]]), np.ones(5), SETTINGS
        )
        assert 1 <= aligned <= count == 5
        assert np.array_equal(reconstruction.image(3).point2D(0).xy, before) or aligned == 5


def test_threads_do_not_change_the_result(scene):
    moved = []
    for threads in (1, 2, 8):
        reconstruction = model_of(scene, 0.2)
        settings = AlignmentSettings(threads=threads)
        assert refine_keypoints(reconstruction, read(scene[1]), np.ones(5), settings) == (750, 750)
        moved.append([reconstruction.image(i).point2D(k).xy for i in range(1, 6) for k in range(150)])
    for others in moved[1:]:
        np.testing.assert_array_equal(moved[0], others)


def test_patches_outside_do_not_move(scene):
    images = np.array([0, 1])
    pixels = np.array([[3.0, 3.0], [200.0, 150.0]])
    tangents = np.tile(np.eye(2), (2, 1, 1))
    moved, aligned = align_observations(
        read(scene[1]), images, pixels, tangents, np.array([1, 1]), np.array([False, True]), SETTINGS
    )
    np.testing.assert_array_equal(moved, pixels)
    assert not aligned.any()


def test_the_template_is_the_central_view_with_its_patch_inside_a_sharp_image():
    angles = np.array([-0.4, 0.05, 0.5])
    directions = np.column_stack([np.sin(angles), np.zeros(3), np.cos(angles)])
    offsets = np.array([0, 3])

    def chosen(sizes=(0.0, 0.0, 0.0), inside=(True, True, True), blurred=(False, False, False)):
        columns = np.array(sizes), np.array(inside), np.array(blurred)
        return choose_templates(directions, *columns, offsets).tolist()

    assert chosen() == [1]
    assert chosen(sizes=(0.0, 2.0, 0.0)) != [1]
    assert chosen(inside=(True, False, True)) == [0]
    assert chosen(blurred=(False, True, False)) == [0]
    # outside there is nothing to align to
    assert chosen(inside=(False, True, False), blurred=(False, True, False)) == [1]
    assert chosen(blurred=(True, True, True)) == [1]


def in_motion(image: np.ndarray) -> np.ndarray:
    """An image blurred over nine pixels of a row."""
    return cv2.blur(image, (9, 1))


def source_of(images, threads: int = 1) -> ImageSource:
    settings = AlignmentSettings(threads=threads)
    return ImageSource(read(images), np.ones(5), settings, lambda aligned, count: None, lambda: None)


@pytest.mark.parametrize("threads", [1, 2])
def test_blurred_images_are_told_from_those_of_even_surfaces_and_of_dim_light(scene, threads: int):
    look = texture(0)
    even = look[:, :600]
    even[:] = cv2.GaussianBlur(even, (0, 0), 5)
    images = [render(look, plane_to_image(*pose)) for pose in scene[2]]
    images[1] = in_motion(images[1])
    images[3] = (images[3] * 0.3).astype(np.uint8)
    reconstruction = model_of(scene, 0.2)
    for row in np.flatnonzero(scene[0][:, 0] > -0.2).tolist():
        reconstruction.delete_observation(5, row)
    assert find_blurred(reconstruction, source_of(images, threads)) == [1]


def test_no_image_is_blurred_where_none_can_be_read_or_none_is_sharper(scene):
    assert find_blurred(model_of(scene, 0.2), source_of([None] * 5)) == []
    assert find_blurred(model_of(scene, 0.2), source_of([in_motion(image) for image in scene[1]])) == []
    assert find_blurred(model_of(scene, 0.2), source_of([np.zeros((300, 400), np.uint8)] * 5)) == []


def test_sharp_images_align_as_well_beside_a_blurred_one(scene):
    """Though that one is the most central view, and the template of most points where all are sharp."""
    images = list(scene[1])
    images[2] = in_motion(images[2])
    sharp, beside, to_blurred = (model_of(scene, 0.35) for _ in range(3))
    assert find_blurred(beside, source_of(images)) == [2]
    refine_by_sources(sharp, [source_of(scene[1])], ())
    refine_by_sources(beside, [source_of(images)], [2])
    refine_keypoints(to_blurred, read(images), np.ones(5), SETTINGS)
    found = [np.median(spread_px(model, scene[3], without=2)) for model in (sharp, beside, to_blurred)]
    assert 0.001 < found[1] < 1.2 * found[0] < 0.5 * found[2]


@pytest.mark.parametrize(
    ("camera_ids", "shared"),
    [([0, 0, 0], True), ([0, 1, 2, 3], False), ([0, 0, 1, 2], False), ([0, 0, 1, 1, 2], True)],
    ids=["one camera", "one each", "half", "two cameras"],
)
def test_photographs_of_one_camera_are_told_from_those_of_many(camera_ids: list[int], shared: bool) -> None:
    assert most_share_a_camera(np.array(camera_ids)) is shared
