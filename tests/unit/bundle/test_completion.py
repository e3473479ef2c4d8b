"""Completion of models of dense video, whose frames are mostly near copies of others."""

from itertools import combinations

import cv2  # noqa: F401
import numpy as np
import pytest

from snakesfm.bundle import completion
from snakesfm.bundle.completion import complete_tracks, correspondence_graph, matches_with_parallax
from snakesfm.bundle.model import BundleModel, to_reconstruction
from snakesfm.geometry.camera import Camera

NEAR, PLACES, COPIES = 40, 3, 4


def filmed(far, noise_px=0.3):
    """Images of three places, four each, of near points and of others too far away for any parallax.

    Returns
    -------
    Poses without points, and the matches of all images.
    """
    rng = np.random.default_rng(0)
    camera = Camera("SIMPLE_PINHOLE", 1000, 800, (900.0, 500.0, 400.0))
    count, points = PLACES * COPIES, NEAR + far
    depths = np.r_[rng.uniform(8, 12, NEAR), np.full(far, 1e6)]
    xyz = np.c_[rng.uniform(-0.3, 0.3, (points, 2)), np.ones(points)] * depths[:, None]
    centers = np.zeros((count, 3))
    centers[:, 0] = np.repeat(np.arange(PLACES), COPIES) + 0.001 * np.arange(count)
    seen = xyz[None] - centers[:, None]
    pixels = 900.0 * seen[..., :2] / seen[..., 2:] + [500.0, 400.0]
    keypoints = (pixels + rng.normal(0, noise_px, pixels.shape)).astype(np.float32)
    nothing = np.zeros(0, np.int32)
    model = BundleModel(
        (camera,),
        np.zeros(count, int),
        np.tile(np.eye(3), (count, 1, 1)),
        -centers,
        np.zeros((0, 3)),
        np.zeros(1, np.int64),
        nothing,
        nothing,
    )
    pairs = np.array(list(combinations(range(count), 2)))
    matches = np.tile(np.arange(points)[:, None], (len(pairs), 2))
    graph = correspondence_graph(
        {row: points for row in range(count)}, pairs, np.arange(len(pairs) + 1) * points, matches
    )
    return to_reconstruction(model, list(keypoints), [str(row) for row in range(count)]), graph


def test_keypoints_without_parallax_keep_no_match_where_they_are_most():
    poses, graph = filmed(2 * NEAR)
    kept = matches_with_parallax(poses, graph, 1.0)
    # near copies too, of what others see from elsewhere
    assert {
        kept.num_matches_between_images(i, j) for i, j in combinations(sorted(poses.reg_image_ids()), 2)
    } == {NEAR}


@pytest.mark.parametrize(("far", "min_angle_deg"), [(NEAR // 10, 1.0), (2 * NEAR, 1e-9)])
def test_all_matches_stay_where_most_show_parallax(far, min_angle_deg):
    poses, graph = filmed(far)
    assert matches_with_parallax(poses, graph, min_angle_deg) is graph


def test_points_are_those_of_all_matches_without_false_ones_beside_the_cameras(monkeypatch):
    depths = []
    for least in (completion.MOST_WITH_PARALLAX, 0.0):
        monkeypatch.setattr(completion, "MOST_WITH_PARALLAX", least)
        poses, graph = filmed(2 * NEAR)
        complete_tracks(poses, graph, 4.0, 1.0, 0)
        depths.append([point.xyz[2] for point in poses.points3D.values()])
        long = [point.track.length() == PLACES * COPIES for point in poses.points3D.values()]
        assert sum(long) == NEAR
    assert min(depths[0]) > 7 and len(depths[0]) == NEAR
    # near copies of a far point, tried all the same, meet next to them
    assert min(depths[1]) < 1
