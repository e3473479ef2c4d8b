"""The oracle: where a known model's points are, and their matches."""

import numpy as np
import pycolmap
import pytest
from known_model import SIZE, synthesize_model

from snakesfm.errors import ConfigError
from snakesfm.evaluation.colmap_model import read_model
from snakesfm.features.virtual import VirtualKeypoints
from snakesfm.features.virtual_points import ViewPoints
from snakesfm.matching.matcher import MATCHERS


@pytest.fixture(scope="module")
def model():
    return synthesize_model()


def test_keypoints_are_exact_projections_of_what_an_image_observes(model):
    source = VirtualKeypoints(model)
    for image in model.images.values():
        found = source.read(image.name, SIZE)
        ids = found.descriptors.copy().view("<u4").ravel()
        observed = {point.point3D_id for point in image.points2D if point.has_point3D()}
        assert set(ids.tolist()) == observed and len(observed) > 20
        for place, number in zip(found.keypoints, ids.tolist(), strict=True):
            expected = image.project_point(model.points3D[number].xyz)
            np.testing.assert_allclose(place, expected, atol=1e-3)


def test_the_matcher_pairs_the_same_points_and_no_others(model):
    source, matcher = VirtualKeypoints(model), MATCHERS["virtual"]()
    first, second = (source.read(image.name, SIZE) for image in list(model.images.values())[:2])
    second = second.take(np.random.default_rng(0).permutation(len(second)))
    matches, scores = matcher.match(matcher.prepare(first), matcher.prepare_second(second))
    np.testing.assert_array_equal(first.descriptors[matches[:, 0]], second.descriptors[matches[:, 1]])
    shared = set(map(bytes, first.descriptors)) & set(map(bytes, second.descriptors))
    assert len(matches) == len(shared) > 10
    assert (np.diff(matches[:, 0]) > 0).all() and (scores == 1).all()
    nothing = source.read("unknown.jpg", SIZE)
    assert len(nothing) == 0
    assert matcher.match(matcher.prepare(nothing), matcher.prepare_second(second))[0].shape == (0, 2)


def test_points_spread_over_the_views_are_seen_wherever_they_project(model):
    source = VirtualKeypoints(model, view_points=40)
    seen = {}
    for image in model.images.values():
        found = source.read(image.name, SIZE)
        seen[image.name] = dict(zip(map(bytes, found.descriptors), found.keypoints, strict=True))
        # its own 40 lie in its view, and of the other three images' some
        assert 40 <= len(found) <= 160
    assert len(set().union(*seen.values())) == 160
    again = VirtualKeypoints(model, view_points=40).read(image.name, SIZE)
    np.testing.assert_array_equal(again.keypoints, found.keypoints)
    first, second = list(model.images.values())[:2]
    shared = sorted(seen[first.name].keys() & seen[second.name].keys())
    assert len(shared) > 20
    rays = [
        image.camera.cam_from_img(np.array([seen[image.name][number] for number in shared], float))
        for image in (first, second)
    ]
    relative = second.cam_from_world() * first.cam_from_world().inverse()
    essential = pycolmap.essential_matrix_from_pose(relative)
    one, other = (np.column_stack([part, np.ones(len(part))]) for part in rays)
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", other, essential, one), 0, atol=1e-5)


def test_points_of_a_view_are_as_deep_as_what_the_image_observes(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 1000 800 1000 500 400\n")
    (tmp_path / "images.txt").write_text(
        "1 1 0 0 0 0 0 0 1 a.jpg\n250 400 1 750 400 2\n2 1 0 0 0 0 0 0 1 b.jpg\n\n"
    )
    (tmp_path / "points3D.txt").write_text("1 -0.5 0 2 9 9 9 0 1 0\n2 1 0 4 9 9 9 0 1 1\n")
    found = ViewPoints(read_model(tmp_path), 500).seen_by(read_model(tmp_path).images[1])
    # image b observes nothing, so it spreads nothing
    assert found.places.shape == (500, 3)
    np.testing.assert_array_equal(found.places[:, 2], np.where(found.places[:, 0] < 0, 2.0, 4.0))
    assert 200 < (found.places[:, 0] < 0).sum() < 300


def test_a_model_without_points_is_refused_unless_they_are_spread(tmp_path):
    with pytest.raises(ConfigError, match="has no points"):
        VirtualKeypoints(pycolmap.Reconstruction())
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 1000 800 1000 500 400\n")
    (tmp_path / "images.txt").write_text(
        "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 -0.1 0 0 1 b.jpg\n\n3 1 0 0 0 -0.1 0 0 1 c.jpg\n\n"
    )
    (tmp_path / "points3D.txt").write_text("")
    model = read_model(tmp_path)
    depths = ViewPoints(model, 400).seen_by(model.images[1]).places[:, 2]
    # b and c are in one place, and the nearest other camera is 0.1 away for each
    assert len(depths) == 1200 and 0.2 <= depths.min() < 0.25 and 4 < depths.max() <= 5
    assert len(VirtualKeypoints(model, view_points=400).read("a.jpg", (1000, 800))) > 1000


def test_points_that_distortion_folds_into_the_image_are_not_seen(tmp_path):
    # at the lens's edge, x = 1.6 at depth 1, the model of distortion turns round: 1.6 (1 - 0.5 * 1.6^2) = -0.45
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 1000 800 500 500 400 -0.5\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n600 400 1 275 400 2\n")
    (tmp_path / "points3D.txt").write_text(
        "1 0.2 0 1 9 9 9 0 1 0\n2 1.6 0 1 9 9 9 0 1 1\n",
    )
    found = VirtualKeypoints(read_model(tmp_path)).read("a.jpg", (1000, 800))
    np.testing.assert_allclose(found.keypoints, [[500 + 500 * 0.2 * (1 - 0.5 * 0.04), 400]], atol=1e-3)
