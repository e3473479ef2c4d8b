"""Tracks from matches: components, conflicts and observations."""

import numpy as np
import pytest

from snakesfm.synthetic.problems import make_problem
from snakesfm.tracks.build import build_tracks
from snakesfm.tracks.confirmation import cycle_support


def spread_keypoints(images, count):
    grid = np.stack([np.arange(count) * 10.0, np.arange(count) * 7.0], axis=1).astype(np.float32)
    return [grid + image for image in range(images)]


def matches_of(table):
    pairs = sorted(table)
    offsets = np.r_[0, np.cumsum([len(table[p]) for p in pairs])].astype(np.int64)
    flat = np.array([m for p in pairs for m in table[p]], dtype=np.int32).reshape(-1, 2)
    return np.array(pairs, dtype=np.int32).reshape(-1, 2), offsets, flat


def as_sets(tracks):
    rows = list(zip(tracks.image_ids.tolist(), tracks.keypoint_ids.tolist(), strict=True))
    return [rows[a:b] for a, b in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True)]


def parts_of(tracks):
    rows = list(zip(tracks.image_ids.tolist(), tracks.keypoint_ids.tolist(), strict=True))
    return [
        [rows[k] for k in np.nonzero(tracks.part_ids == part)[0]] for part in np.unique(tracks.part_ids)
    ]


def test_chains_become_tracks_sorted_by_first_observation():
    table = {(0, 1): [(5, 1), (2, 2)], (1, 2): [(1, 4), (2, 0)], (0, 2): [(2, 0)]}
    tracks = build_tracks(spread_keypoints(3, 6), *matches_of(table))
    assert as_sets(tracks) == [[(0, 2), (1, 2), (2, 0)], [(0, 5), (1, 1), (2, 4)]]
    assert tracks.conflicts == 0
    assert tracks.offsets.dtype == np.int64 and tracks.image_ids.dtype == np.int32


def test_short_tracks_are_left_out():
    table = {(0, 1): [(0, 0), (1, 1)], (1, 2): [(0, 0)]}
    assert len(as_sets(build_tracks(spread_keypoints(3, 3), *matches_of(table), min_length=3))) == 1
    assert len(as_sets(build_tracks(spread_keypoints(3, 3), *matches_of(table), min_length=2))) == 2


def test_images_of_few_long_tracks_keep_their_short_ones():
    long = [(k, k) for k in range(3)]
    table = {(0, 1): [*long, (3, 3)], (1, 2): long, (0, 2): long, (2, 3): [(4, 0)], (1, 3): [(5, 1)]}
    of_three = [[(0, k), (1, k), (2, k)] for k in range(3)]

    def tracks(sparse_observations):
        return as_sets(
            build_tracks(
                spread_keypoints(4, 6), *matches_of(table), sparse_observations=sparse_observations
            )
        )

    assert tracks(0) == of_three
    # the last image is in no track of three, the others are in as many as are asked for
    assert tracks(3) == [*of_three, [(1, 5), (3, 1)], [(2, 4), (3, 0)]]
    assert tracks(4) == [*of_three, [(0, 3), (1, 3)], [(1, 5), (3, 1)], [(2, 4), (3, 0)]]


def test_no_matches_give_no_tracks():
    tracks = build_tracks(spread_keypoints(2, 3), *matches_of({}))
    assert tracks.offsets.tolist() == [0] and len(tracks.image_ids) == 0
    assert build_tracks([], *matches_of({})).offsets.tolist() == [0]


def clique(images, keypoint):
    return {(i, j): [(keypoint, keypoint)] for i in images for j in images if i < j}


def joined(*tables):
    pairs = {pair for table in tables for pair in table}
    return {pair: [m for table in tables for m in table.get(pair, [])] for pair in pairs}


def test_look_alikes_of_images_that_share_nothing_are_parts_of_their_own():
    places = [clique(range(0, 4), k) for k in range(3)] + [clique(range(4, 8), k) for k in range(3)]
    between = clique(range(2, 6), 3)
    wrong = {(1, 6): [(0, 0), (1, 1)]}
    tracks = build_tracks(spread_keypoints(8, 4), *matches_of(joined(*places, between, wrong)))
    expected = [[(i, k) for i in range(0, 4)] for k in range(3)]
    expected += [[(i, k) for i in range(4, 8)] for k in range(3)]
    assert sorted(parts_of(tracks)) == sorted([*expected, [(i, 3) for i in range(2, 6)]])
    assert [(i, 0) for i in range(8)] in as_sets(tracks)


def test_unconfirmed_matches_stay_where_nothing_else_joins_two_parts():
    places = [clique(range(0, 4), 0), clique(range(4, 8), 0)]
    bridge = {(3, 4): [(0, 0)]}
    tracks = build_tracks(spread_keypoints(8, 1), *matches_of(joined(*places, bridge)))
    assert parts_of(tracks) == [[(i, 0) for i in range(8)]]


def test_image_whose_matches_are_mostly_unconfirmed_keeps_them():
    places = [clique(range(0, 4), k) for k in range(3)]
    last = joined({(3, 4): [(k, k) for k in range(3)]}, {(2, 4): [(0, 0)]})
    tracks = build_tracks(spread_keypoints(5, 3), *matches_of(joined(*places, last)))
    assert parts_of(tracks) == [[(i, k) for i in range(5)] for k in range(3)]


def test_conflict_is_dropped_whole():
    table = {(0, 1): [(0, 0)], (1, 2): [(0, 0)], (2, 3): [(0, 0)], (0, 3): [(1, 0)]}
    tracks = build_tracks(spread_keypoints(4, 2), *matches_of(table))
    assert as_sets(tracks) == [] and tracks.conflicts == 1


def test_near_keypoints_of_one_image_are_one_observation():
    keypoints = spread_keypoints(3, 3)
    keypoints[1][1] = keypoints[1][0] + np.float32(0.5)
    table = {(0, 1): [(0, 0)], (1, 2): [(1, 0)], (0, 2): [(0, 0)]}
    joined = build_tracks(keypoints, *matches_of(table), merge_radius_px=1.0)
    assert as_sets(joined) == [[(0, 0), (1, 0), (2, 0)]] and joined.conflicts == 0
    apart = build_tracks(keypoints, *matches_of(table), merge_radius_px=0.4)
    assert as_sets(apart) == [] and apart.conflicts == 1


@pytest.mark.parametrize("best", [0, 1])
def test_the_better_linked_of_near_keypoints_is_the_observation(best):
    keypoints = [np.array([[10, 10], [10.3, 10]], np.float32), *spread_keypoints(3, 1)]
    pairs = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    table = {pair: [(best if pair[0] == 0 else 0, 0)] for pair in pairs} | {(0, 3): [(1 - best, 0)]}
    tracks = build_tracks(keypoints, *matches_of(table))
    assert as_sets(tracks) == [[(0, best), (1, 0), (2, 0), (3, 0)]]


def test_cycle_support_counts_triangles():
    links = np.array([(0, 1), (1, 2), (0, 2), (2, 3)])
    np.testing.assert_array_equal(cycle_support(links, 4), [1, 1, 1, 0])


@pytest.mark.parametrize("outlier_ratio", [0.0, 0.05])
def test_synthetic_scene_gives_true_tracks(outlier_ratio):
    problem = make_problem(15, 600, outlier_ratio=outlier_ratio, seed=2)
    tracks = build_tracks(list(problem.keypoints), problem.pairs, problem.match_offsets, problem.matches)
    shown = np.concatenate(problem.keypoint_points)
    base = np.r_[0, np.cumsum([len(k) for k in problem.keypoints])]
    points = shown[base[tracks.image_ids] + tracks.keypoint_ids]
    pure = [
        len(np.unique(points[a:b])) == 1 for a, b in zip(tracks.offsets, tracks.offsets[1:], strict=False)
    ]
    for a, b in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True):
        assert np.all(np.diff(tracks.image_ids[a:b]) > 0)
    if outlier_ratio == 0:
        assert all(pure) and tracks.conflicts == 0
    else:
        assert 0.5 < np.mean(pure) < 1.0
        assert tracks.conflicts > 10
        shown_parts = {}
        for part, point in zip(tracks.part_ids.tolist(), points.tolist(), strict=True):
            shown_parts.setdefault(part, set()).add(point)
        pure_parts = [len(shows) == 1 for shows in shown_parts.values()]
        assert np.mean(pure) < np.mean(pure_parts) < 1.0
