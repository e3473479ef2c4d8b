"""Matches on what all photographs show at one place."""

from itertools import combinations

import numpy as np
import pytest

from snakesfm.matching.overlays import cover_images, find_moving_matches, find_overlay_cells

SIZE = (640, 480)
COUNT = 10


def matched_pairs(seed: int, overlay: int, moved: float = 30.0, twins: bool = False) -> list:
    """All pairs of ten images: 60 points of the scene that move, ``overlay`` places of a stamp that do not.

    The stamp covers columns 400 to 600 and rows 420 to 460; of its 40 places each image shows a few.
    """
    rng = np.random.default_rng(seed)
    stamp = rng.uniform((400, 420), (600, 460), (40, 2))
    pairs = []
    for _ in combinations(range(COUNT), 2):
        scene = rng.uniform((0, 0), SIZE, (60, 2))
        shift = rng.uniform(-1, 1, 2)
        away = scene + moved * shift / np.linalg.norm(shift) + rng.normal(0, 2, scene.shape)
        seen = stamp[rng.permutation(len(stamp))[:overlay]]
        first = np.r_[scene, seen]
        second = np.r_[scene if twins else away, seen]
        pairs.append((SIZE, first, second + rng.normal(0, 0.1, second.shape)))
    return pairs


def test_a_time_stamp_is_found_where_it_is() -> None:
    cells = find_overlay_cells(matched_pairs(0, overlay=12), 0.3)
    assert cells.dtype == np.int32
    assert (cells[:, :2] == SIZE).all()
    # 200 x 40 pixels and a cell around it
    assert cells[:, 2].min() in (48, 49, 50)
    assert cells[:, 2].max() in (74, 75, 76)
    assert cells[:, 3].min() in (51, 52)
    assert cells[:, 3].max() in (57, 58)
    assert cover_images(cells)[SIZE].mean() == pytest.approx(len(cells) / (81 * 61))
    assert 100 < len(cells) < 230


def test_what_stands_still_there_goes_and_all_else_stays() -> None:
    pairs = matched_pairs(1, overlay=12)
    covered = cover_images(find_overlay_cells(pairs, 0.3))
    for _, first, second in pairs:
        moving = find_moving_matches(covered, np.array([SIZE, SIZE]), first, second)
        assert not moving[60:].any()
        # they move through the stamp's cells, too
        assert moving[:60].all()
        assert find_moving_matches(covered, np.array([SIZE, SIZE[::-1]]), first, second).all()
        assert find_moving_matches(covered, np.array([(320, 240)] * 2), first, second).all()
        # a static camera's scene elsewhere
        assert find_moving_matches(
            covered, np.array([SIZE, SIZE]), first[:60] % 300, first[:60] % 300
        ).all()


def test_the_margins_of_an_overlay_that_something_hides_belong_to_it() -> None:
    pairs = matched_pairs(2, overlay=12)
    edge = np.random.default_rng(0).uniform((100, 100), (108, 108), (3, 2))
    # one pair in nine shows another part of it
    for k in range(0, len(pairs), 9):
        size, first, second = pairs[k]
        pairs[k] = (size, np.r_[first, edge], np.r_[second, edge])
    assert ((find_overlay_cells(pairs, 0.3)[:, 2:] == (12, 12)).all(axis=1)).any()
    assert len(find_overlay_cells(pairs[::9][:2], 0.3)) == 0


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_scenes_without_an_overlay_have_none(share: float) -> None:
    assert len(find_overlay_cells(matched_pairs(3, overlay=0), share)) == 0
    # copies of one view
    twins = matched_pairs(4, overlay=0, twins=True)[:15]
    assert len(find_overlay_cells(twins + matched_pairs(4, overlay=0)[15:], share)) == 0
    assert len(find_overlay_cells([], share)) == 0


@pytest.mark.parametrize(("moved", "found"), [(6.0, False), (20.0, True)])
def test_what_is_far_in_a_slow_video_is_no_overlay(moved: float, found: bool) -> None:
    cells = find_overlay_cells(matched_pairs(7, overlay=12, moved=moved), 0.3)
    assert (100 < len(cells) < 230) if found else len(cells) == 0


def test_what_few_pairs_show_is_no_overlay() -> None:
    rare = matched_pairs(5, overlay=12)[:8] + matched_pairs(5, overlay=0)[8:]
    assert len(find_overlay_cells(rare, 0.3)) == 0
    assert len(find_overlay_cells(rare, 0.1)) > 50


def test_the_order_of_pairs_does_not_matter() -> None:
    pairs = matched_pairs(6, overlay=12)
    np.testing.assert_array_equal(find_overlay_cells(pairs, 0.3), find_overlay_cells(pairs[::-1], 0.3))
