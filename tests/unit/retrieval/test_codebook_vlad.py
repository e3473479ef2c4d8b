"""Codebook and VLAD on synthetic descriptors."""

import numpy as np
import pytest

from snakesfm.retrieval.codebook import learn_codebook, nearest_words, sample_rows
from snakesfm.retrieval.vlad import describe_vlad


def clouds(words=12, each=300, seed=0):
    """Descriptors around known centres."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(20, 200, (words, 128))
    spread = rng.normal(scale=3, size=(words, each, 128))
    return centers, np.clip(centers[:, None] + spread, 0, 255).reshape(-1, 128).astype(np.uint8)


def test_sampling_is_seeded_distinct_and_sorted():
    rows = sample_rows(1000, 50, 3)
    np.testing.assert_array_equal(rows, sample_rows(1000, 50, 3))
    assert (np.diff(rows) > 0).all() and len(rows) == 50
    assert not np.array_equal(rows, sample_rows(1000, 50, 4))
    np.testing.assert_array_equal(sample_rows(5, 50, 3), np.arange(5))


def test_words_are_nearest():
    _, descriptors = clouds()
    centers = np.random.default_rng(1).uniform(0, 255, (40, 128)).astype(np.float32)
    distance = np.linalg.norm(descriptors[:, None].astype(float) - centers, axis=2)
    np.testing.assert_array_equal(nearest_words(descriptors, centers), distance.argmin(axis=1))


def test_codebook_lowers_the_distance_to_words():
    _, descriptors = clouds()
    centers = learn_codebook(descriptors, 24, 20, 5)
    assert centers.shape == (24, 128) and centers.dtype == np.float32
    distance = np.linalg.norm(centers[nearest_words(descriptors, centers)] - descriptors, axis=1)
    # the spread is 3 * sqrt(128) = 34; without learning, other clouds are some 800 away
    assert 25 < np.median(distance) < 40
    np.testing.assert_array_equal(centers, learn_codebook(descriptors, 24, 20, 5))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_descriptors_give_few_words(count):
    _, descriptors = clouds()
    assert learn_codebook(descriptors[:count], 64, 20, 1).shape == (count, 128)


def test_vlad_knows_a_scene_again():
    rng = np.random.default_rng(2)
    _, descriptors = clouds()
    centers = learn_codebook(descriptors, 12, 20, 1)
    scenes = [rng.integers(0, 255, (400, 128)).astype(np.uint8) for _ in range(5)]
    views = [
        np.concatenate([scene[rng.permutation(400)[:250]], rng.integers(0, 255, (150, 128))]).astype(
            np.uint8
        )
        for scene in scenes
    ]
    first = np.array([describe_vlad(scene, centers, 0.5) for scene in scenes])
    second = np.array([describe_vlad(view, centers, 0.5) for view in views])
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1, atol=2e-3)
    np.testing.assert_array_equal((first @ second.T).argmax(axis=1), np.arange(5))


def test_vlad_similarity_is_exact_in_any_order():
    _, descriptors = clouds()
    centers = learn_codebook(descriptors, 12, 5, 1)
    vector, other = (describe_vlad(descriptors[k::7], centers, 0.5) for k in (0, 1))
    exact = float(vector.astype(np.float64) @ other.astype(np.float64))
    order = np.random.default_rng(0).permutation(len(vector))
    assert float(vector @ other) == exact == float(vector[order] @ other[order])


def test_no_descriptors_are_a_zero_vector():
    centers = np.ones((4, 128), np.float32)
    assert not describe_vlad(np.zeros((0, 128), np.uint8), centers, 0.5).any()
    assert describe_vlad(np.ones((9, 128), np.uint8), np.zeros((0, 128), np.float32), 0.5).shape == (0,)
