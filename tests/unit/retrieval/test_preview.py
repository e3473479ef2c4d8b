"""Pairs are looked at by their largest keypoints, and each image keeps so many partners."""

import dataclasses

import numpy as np
import pytest

from snakesfm.features.keypoints import KeypointSet
from snakesfm.features.sift import rootsift
from snakesfm.grouping import components_of
from snakesfm.retrieval.preview import (
    alike_pairs,
    choose_partners,
    largest_keypoints,
    likeness,
    look_at_pairs,
)


def histograms(count, seed):
    return np.random.default_rng(seed).exponential(size=(count, 128)).astype(np.float32) ** 2


def image(descriptors, seed=0):
    """Keypoints with scales in random order."""
    rng = np.random.default_rng(seed)
    count = len(descriptors)
    places = rng.uniform(0, 500, (count, 2)).astype(np.float32)
    ones = np.ones(count, np.float32)
    return KeypointSet(places, rootsift(descriptors), ones, rng.permutation(count).astype(np.float32), ones)


def overlapping(count, shared, seed=0):
    """Two images of ``count`` keypoints that share some of theirs, with noise, at the same scales."""
    rng = np.random.default_rng(seed)
    common = histograms(shared, 1)
    noisy = common * rng.uniform(0.6, 1.4, common.shape).astype(np.float32)
    first = image(np.concatenate([common, histograms(count - shared, 2)]))
    second = image(np.concatenate([noisy, histograms(count - shared, 3)]))
    return first, dataclasses.replace(second, scales=first.scales)


def preview(points, count):
    return points.descriptors[largest_keypoints(points.scales, count)]


@pytest.mark.parametrize(
    ("keypoints", "count", "taken"),
    [(600, 200, 200), (600, 300, 300), (600, 400, 300), (120, 400, 60), (60, 400, 50), (9, 400, 9)],
)
def test_the_largest_are_chosen_and_of_few_keypoints_half(keypoints, count, taken):
    scales = np.random.default_rng(0).permutation(keypoints).astype(np.float32)
    np.testing.assert_array_equal(largest_keypoints(scales, count), np.argsort(scales)[::-1][:taken])


def test_equal_scales_are_taken_from_the_front():
    np.testing.assert_array_equal(largest_keypoints(np.ones(60, np.float32), 20), np.arange(20))


def test_likeness_grows_with_what_is_shared():
    values = []
    for shared in (0, 100, 400, 1000):
        first, second = (preview(points, 400) for points in overlapping(1000, shared))
        values.append(likeness(first, second))
    assert 0 < values[0] < 1.5
    assert values[1] > 4 * values[0] and values[2] > 2 * values[1] and values[3] > 1.5 * values[2]
    assert values[3] < 400


def test_likeness_of_equal_images_and_of_equal_descriptors_is_finite():
    some = rootsift(histograms(50, 1))
    assert likeness(some, some) == pytest.approx(50.0)
    assert likeness(some[:1].repeat(50, axis=0), some[:1].repeat(50, axis=0)) == 0.0


def test_likeness_is_the_same_in_both_directions_for_strangers_and_relatives():
    for shared in (0, 300):
        first, second = (preview(points, 300) for points in overlapping(800, shared))
        assert 0.5 < likeness(first, second) / likeness(second, first) < 2.0


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_pairs_are_looked_at_one_by_one_whatever_the_threads(threads):
    previews = [rootsift(histograms(40, seed)) for seed in (1, 2, 1)]
    previews.insert(1, previews[0][:1])
    previews.append(previews[0][:20])
    pairs = np.array([[0, 1], [0, 2], [0, 3], [2, 3], [3, 4]])
    looked = look_at_pairs(pairs, previews, 40, threads)
    assert looked.dtype == np.float32 and looked[0] == 0
    expected = [likeness(previews[i], previews[j]) for i, j in pairs[1:4].tolist()]
    np.testing.assert_allclose(looked[1:4], expected, rtol=1e-6)
    assert looked[2] == pytest.approx(40.0) and looked[1] < 10
    # as if there were as many as elsewhere, but not of next to no keypoints
    assert looked[4] == pytest.approx(20.0)
    most = [previews[0], previews[2]]
    assert look_at_pairs(np.array([[0, 1]]), most, 80)[0] == pytest.approx(likeness(*most) * 80 / 50)
    assert look_at_pairs(np.zeros((0, 2), int), previews, 40, threads).shape == (0,)


def test_strangers_with_few_keypoints_resemble_each_other_no_more_than_others():
    first, second = (image(histograms(5000, seed)) for seed in (1, 2))
    for keypoints in (200, 400, 800):
        few = first.take(np.arange(keypoints))
        previews = [preview(few, 400), preview(second, 400)]
        assert 0.1 < look_at_pairs(np.array([[0, 1]]), previews, 400)[0] < 3.0


def partners_by_hand(pairs, likenesses, enough_partners, enough_likeness):
    """The rule, image by image, as a person would follow it."""
    stays = set()
    near = (enough_partners + 1) // 2
    for image in np.unique(pairs):
        own = [row for row in range(len(pairs)) if image in pairs[row]]
        own.sort(key=lambda row: (-likenesses[row], pairs[row].sum() - image))
        alternate = own[near : near + 2 * (enough_partners // 2) : 2]
        turns = own[:near] + alternate + [row for row in own[near:] if row not in alternate]
        total = 0.0
        for place, row in enumerate(turns):
            if place < enough_partners or total < enough_likeness:
                stays.add(row)
            total += likenesses[row]
    while apart := rows_apart(pairs, stays):
        for image in np.unique(pairs):
            own = [row for row in apart if image in pairs[row]]
            own.sort(key=lambda row: (-likenesses[row], pairs[row].sum() - image))
            stays.update(own[: max(1, enough_partners // 10)])
    return sorted(stays)


def rows_apart(pairs, stays):
    """The pairs whose images are more than four of those that stay apart."""
    joined = {image: {image} for image in pairs.ravel().tolist()}
    for _ in range(4):
        joined = {
            image: near.union(
                *(set(pairs[row].tolist()) for row in stays if near & set(pairs[row].tolist()))
            )
            for image, near in joined.items()
        }
    return [
        row for row in range(len(pairs)) if row not in stays and pairs[row][1] not in joined[pairs[row][0]]
    ]


@pytest.mark.parametrize(
    "enough", [(1, 0.0), (4, 0.0), (5, 20.0), (2, 60.0), (100, 0.0), (1, 1e9), (20, 0.0)]
)
def test_partners_are_chosen_as_by_hand(enough):
    rng = np.random.default_rng(3)
    pairs = np.column_stack(np.triu_indices(14, 1))
    pairs = pairs[rng.permutation(len(pairs))[:70]]
    # a chain beside it, whose ends are alike, is a loop
    chain = np.array([[k, k + 1] for k in range(14, 26)] + [[14, 26], [14, 20]])
    pairs = np.concatenate([pairs, chain])
    # whole numbers, so that many are alike
    likenesses = np.round(rng.exponential(6.0, len(pairs))).astype(np.float32)
    stays = choose_partners(pairs, likenesses, *enough)
    assert np.flatnonzero(stays).tolist() == partners_by_hand(pairs, likenesses, *enough)
    order = rng.permutation(len(pairs))
    np.testing.assert_array_equal(choose_partners(pairs[order], likenesses[order], *enough), stays[order])


def test_an_image_keeps_its_most_alike_partners_however_little_they_resemble_it():
    pairs = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3], [0, 4], [1, 4]])
    likenesses = np.array([5.0, 0.2, 0.3, 4.0, 0.1, 0.4, 0.01, 0.05], np.float32)
    unsure = np.arange(8) == 6
    # partners in falling order: 0: 1 3 2 4; 1: 0 2 3 4; 2: 1 3 0; 3: 2 0 1; 4: 1 0
    kept = [
        np.flatnonzero(alike_pairs(pairs, likenesses, unsure, 1.5, least)).tolist()
        for least in (0, 1, 2, 9)
    ]
    assert kept == [[0, 3, 6], [0, 3, 5, 6, 7], [0, 2, 3, 5, 6, 7], list(range(8))]
    assert alike_pairs(pairs, likenesses, unsure, 0.0, 0).all()
    assert alike_pairs(pairs[:0], likenesses[:0], unsure[:0], 1.5, 3).tolist() == []


def test_an_image_of_weak_links_keeps_more_than_enough():
    pairs = np.column_stack([np.zeros(20, int), np.arange(1, 21)])
    weak, strong = np.full(20, 2.0, np.float32), np.full(20, 50.0, np.float32)
    # every other image has one partner and keeps it, so the pairs are listed from the hub's side alone
    hub = np.concatenate([pairs, [[i, j] for i in range(1, 21) for j in range(21, 24)]])
    rest = np.full(60, 100.0, np.float32)
    kept = [choose_partners(hub, np.r_[own, rest], 3, 25.0)[:20].sum() for own in (weak, strong)]
    assert kept == [13, 3]


def test_a_loop_is_closed_though_neighbours_in_time_are_more_alike():
    """Every image resembles 20 before and after it, and a little the one half a round away."""
    count, reach, enough = 120, 20, 10
    pairs = np.column_stack(np.triu_indices(count, 1))
    apart = pairs[:, 1] - pairs[:, 0]
    closing = apart == count // 2
    likenesses = np.where(closing, 2.0, np.maximum(1 + reach - apart, 0) * 4.0).astype(np.float32)
    seen = likenesses > 0
    pairs, likenesses, closing, apart = pairs[seen], likenesses[seen], closing[seen], apart[seen]
    stays = choose_partners(pairs, likenesses, enough, 0.0)
    assert stays[closing].all() and closing.sum() == count // 2
    assert stays[apart == 1].all() and not stays[apart == reach].any()
    assert 0.5 * enough * count < stays[~closing].sum() < enough * count


def test_stops_of_near_copies_stay_tied_together():
    """Each of eight stops resembles the two beside it, but all its images prefer the same one of these."""
    stops, copies = 8, 60
    count = stops * copies
    pairs = np.column_stack(np.triu_indices(count, 1))
    first, second = (pairs // copies).T
    likenesses = np.select([first == second, second - first > 1, first % 2 == 0], [90.0, 0.0, 20.0], 5.0)
    pairs, likenesses = pairs[likenesses > 0], likenesses[likenesses > 0]
    stays = choose_partners(pairs, likenesses.astype(np.float32), 30, 250.0)
    assert not components_of(count, pairs[stays]).any()
    # few more than thirty partners, and three for each of the stops beside
    assert stays.sum() < 38 * count


def test_no_pairs_are_no_partners():
    assert choose_partners(np.zeros((0, 2), int), np.zeros(0, np.float32), 3, 10.0).shape == (0,)
