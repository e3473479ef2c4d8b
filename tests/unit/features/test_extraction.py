"""SIFT's descriptors and places, scaling and colours."""

import numpy as np
import pytest

from snakesfm.features.extraction import DETECTORS, extract_keypoints, sample_colors
from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.sift import rootsift


def test_rootsift_has_length_512_and_the_hellinger_product():
    rng = np.random.default_rng(0)
    histograms = rng.exponential(size=(50, 128)).astype(np.float32)
    descriptors = rootsift(histograms).astype(float)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 512, rtol=0.01)
    shares = histograms / histograms.sum(axis=1, keepdims=True)
    hellinger = np.sqrt(shares) @ np.sqrt(shares).T
    np.testing.assert_allclose(descriptors @ descriptors.T / 512**2, hellinger, atol=0.01)


def test_rootsift_of_nothing_is_finite():
    np.testing.assert_array_equal(rootsift(np.zeros((1, 128), np.float32)), np.zeros((1, 128), np.uint8))
    peak = np.zeros((1, 128), np.float32)
    peak[0, 3] = 512
    assert rootsift(peak)[0, 3] == 255


def test_scaling_keeps_the_edges():
    points = KeypointSet.empty(128, np.uint8)
    points = KeypointSet(
        np.array([[0, 0], [320, 240], [0.5, 0.5]], np.float32),
        np.zeros((3, 128), np.uint8),
        *(np.ones(3, np.float32) for _ in range(3)),
    )
    scaled = points.scaled(2.0, 8.0)
    np.testing.assert_array_equal(scaled.keypoints, [[0, 0], [640, 1920], [1, 4]])
    np.testing.assert_array_equal(scaled.scales, [4, 4, 4])


def test_colors_are_of_the_pixel_that_holds_the_keypoint():
    rgb = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    keypoints = np.array([[0.5, 0.5], [4.99, 3.99], [5.0, 4.0], [2.0, 1.0], [1.999, 0.999]], np.float32)
    expected = [rgb[0, 0], rgb[3, 4], rgb[3, 4], rgb[1, 2], rgb[0, 1]]
    np.testing.assert_array_equal(sample_colors(rgb, keypoints), expected)
    assert sample_colors(rgb, np.zeros((0, 2), np.float32)).shape == (0, 3)


@pytest.mark.parametrize("budget", [30, 200, 600])
def test_a_budget_counts_places_not_orientations(budget):
    rng = np.random.default_rng(1)
    gray = rng.integers(0, 255, (480, 640)).astype(np.uint8)
    found = extract_keypoints(DETECTORS["sift"](), [(gray, np.repeat(gray[..., None], 3, 2))], budget, 760)[
        0
    ]
    assert len(found) == budget == len(np.unique(found.keypoints, axis=0))


def test_real_photographs_match_by_their_true_geometry(data):
    from snakesfm.evaluation.colmap_model import read_model
    from snakesfm.ingest.read import read_image
    from snakesfm.matching.matcher import MATCHERS

    folder = data / "strecha_fountain_p11"
    model = read_model(folder / "reference")
    images = {image.name: image for image in model.images.values()}
    first, second = sorted(images)[:2]
    detector, points = DETECTORS["sift"](), []
    for name in (first, second):
        pixels = read_image(folder / "images" / name)
        points.append(*extract_keypoints(detector, [(pixels.gray, pixels.rgb)], 2000, 760))
    matcher = MATCHERS["mutual_ratio"]()
    matches, _ = matcher.match(matcher.prepare(points[0]), matcher.prepare_second(points[1]))
    rays = []
    for name, part, column in ((first, points[0], 0), (second, points[1], 1)):
        camera = model.cameras[images[name].camera_id]
        plane = camera.cam_from_img(part.keypoints[matches[:, column]].astype(float))
        rays.append(np.column_stack([plane, np.ones(len(plane))]))
    pose = images[second].cam_from_world() * images[first].cam_from_world().inverse()
    x, y, z = pose.translation / np.linalg.norm(pose.translation)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose.rotation.matrix()
    line, back = rays[0] @ essential.T, rays[1] @ essential
    slope = np.sqrt((line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    error = np.abs((rays[1] * line).sum(axis=1)) / slope * camera.mean_focal_length()
    assert len(matches) > 700
    assert (error < 2).mean() > 0.95
    assert 0.01 < np.median(error) < 0.15
