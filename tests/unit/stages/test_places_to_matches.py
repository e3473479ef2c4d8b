"""Stages merge_keypoints and index_matches on places that were matched without keypoints."""

import functools

import cv2
import numpy as np
import pytest
from plain_artifacts import write_plain_index

from snakesfm.artifacts import Header, LocalFeatures, PairMatches
from snakesfm.artifacts.pairs import ImagePairs, PairCoordinates
from snakesfm.config.index_matches import IndexMatchesOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.config.merge_keypoints import MergeKeypointsOptions
from snakesfm.matching.loftr import HELD_FEATURES
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
    assert found.size == size
    # what the pixels show of it, which ends at a whole pixel
    shown = np.array(found.gray.shape[::-1]) * found.reduction
    assert (shown <= size).all() and (shown > np.array(size) - found.reduction).all()


def test_few_images_are_seen_anew_in_a_tile(tmp_path, monkeypatch):
    """Of a matcher that holds what it sees of a few images, as LoFTR does."""
    count = 20
    pixels = np.random.default_rng(0).integers(0, 255, (64, 64), dtype=np.uint8)
    for k in range(count):
        cv2.imwrite(str(tmp_path / f"{k}.jpg"), pixels)
    write_index(tmp_path, [(64, 64)] * count)
    pairs = np.column_stack(np.triu_indices(count, 1))
    some = np.zeros(len(pairs))
    ImagePairs(pairs, [""] * len(pairs), some, some).write(tmp_path / "pairs.h5", HEADER)
    see = [functools.lru_cache(size)(lambda image: image) for size in HELD_FEATURES]
    matched = []

    class Matcher:
        prepare = prepare_second = staticmethod(lambda picture: int(picture.name[:-4]))

        def match(self, first, second):
            matched.append((see[0](first), see[1](second)))
            return np.full((1, 4), first, np.float32), np.full(1, second / count, np.float32)

    monkeypatch.setattr(match_pairs, "_create_detector_free", lambda *_: Matcher())
    inputs = {"index": tmp_path / "index.h5", "pairs": tmp_path / "pairs.h5"}
    options, output = MatchPairsOptions(method="loftr"), tmp_path / "matches.h5"
    match_pairs.run(StageJob("match_pairs", "scene", inputs, (output,), options, {"images": str(tmp_path)}))
    assert len(matched) == len(set(matched)) == len(pairs)
    # on the one side each image once, on the other those behind each strip; the last one is held
    firsts, seconds = (side.cache_info().misses for side in see)
    assert (firsts, seconds) == (19, 19 + 13 + 7)
    found = PairCoordinates.read(output)
    np.testing.assert_array_equal(found.coordinates[:, 0], pairs[:, 0])
    np.testing.assert_allclose(found.scores * count, pairs[:, 1], rtol=1e-5)


def test_places_in_larger_photographs_are_merged_as_far_as_the_matcher_saw_them(run):
    small, small_matches = run(1)
    large, large_matches = run(8, detector_longer_side_px=640)
    np.testing.assert_array_equal(large.keypoints, 8 * small.keypoints)
    np.testing.assert_array_equal(large_matches.matches, small_matches.matches)
    # by their own pixels the places of a point would be up to sixteen apart
    apart, _ = run(8)
    assert np.diff(apart.offsets).min() > 60
