"""Stages merge_keypoints and index_matches on places that were matched without keypoints."""

import cv2
import numpy as np
import pytest
from plain_artifacts import write_plain_index

from snakesfm.artifacts import Header, LocalFeatures, PairMatches
from snakesfm.artifacts.pairs import PairCoordinates
from snakesfm.config.index_matches import IndexMatchesOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.config.merge_keypoints import MergeKeypointsOptions
from snakesfm.stages import index_matches, match_pairs, merge_keypoints
from snakesfm.stages.job import StageJob

HEADER = Header("test", 1, "scene")
SPREAD_PX = 1.0


def write_index(folder, sizes):
    """An index of images 0.jpg, 1.jpg and so on, of these sizes."""
    names = [f"{k}.jpg" for k in range(len(sizes))]
    write_plain_index(folder / "index.h5", names, sizes)


@pytest.fixture
def run(tmp_path):
    """Run both stages on places of 40 points in three images, so many times enlarged."""

    def run_stages(enlarged, **settings):
        folder = tmp_path / f"{enlarged}{len(settings)}"
        folder.mkdir()
        rng = np.random.default_rng(0)
        # far apart from each other, and found anew in every pair
        points = np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2) * 80.0 + 40.0
        pairs = np.array([[0, 1], [0, 2], [1, 2]])
        places = points[None, :, None] + rng.uniform(-SPREAD_PX, SPREAD_PX, (3, 40, 2, 2))
        write_index(folder, [(640 * enlarged, 480 * enlarged)] * 3)
        PairCoordinates(
            pairs=pairs,
            digests=["a", "b", "c"],
            offsets=np.arange(4) * 40,
            coordinates=(places.reshape(-1, 4) * enlarged).astype(np.float32),
            scores=rng.uniform(0.5, 1.0, 120).astype(np.float32),
        ).write(folder / "places.h5", HEADER)
        inputs = {"index": folder / "index.h5", "matches": folder / "places.h5"}
        features, matches = folder / "features.h5", folder / "matches.h5"
        told = {"block": 0, "images": str(folder)} | settings
        options = MergeKeypointsOptions()
        merge_keypoints.run(StageJob("merge_keypoints", "scene", inputs, (features,), options, told))
        inputs |= {"features": [features]}
        options = IndexMatchesOptions()
        index_matches.run(StageJob("index_matches", "scene", inputs, (matches,), options, settings))
        return LocalFeatures.read(features), PairMatches.read(matches)

    return run_stages


def test_places_of_a_point_become_one_keypoint(run):
    features, matches = run(1)
    assert np.diff(features.offsets).tolist() == [40, 40, 40]
    assert np.diff(matches.offsets).tolist() == [40, 40, 40]


@pytest.mark.parametrize(
    ("size", "side", "least"), [((8000, 500), 840, 64), ((900, 440), 64, 64), ((1024, 768), 500, 375)]
)
def test_a_matcher_gets_images_large_enough(tmp_path, size, side, least):
    width, height = size
    pixels = np.random.default_rng(0).integers(0, 255, (height, width), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "0.jpg"), pixels)
    write_index(tmp_path, [size])
    options = MatchPairsOptions(method="loftr", longer_side_px=side)
    inputs, settings = {"index": tmp_path / "index.h5"}, {"images": str(tmp_path)}
    job = StageJob("match_pairs", "scene", inputs, (tmp_path / "m.h5",), options, settings)
    found = match_pairs.ImageFiles(job).read(0)
    # decoded at the smallest fraction that is not too small
    assert least <= min(found.gray.shape) < 2.1 * least
    assert min(found.size) == pytest.approx(height, abs=8)


def test_places_in_larger_photographs_are_merged_as_far_as_the_matcher_saw_them(run):
    small, small_matches = run(1)
    large, large_matches = run(8, detector_longer_side_px=640)
    np.testing.assert_array_equal(large.keypoints, 8 * small.keypoints)
    np.testing.assert_array_equal(large_matches.matches, small_matches.matches)
    # by their own pixels the places of a point would be up to sixteen apart
    apart, _ = run(8)
    assert np.diff(apart.offsets).min() > 60
