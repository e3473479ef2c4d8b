"""hloc's files: what is written is read again, and what other versions of hloc write is read too."""

import h5py
import numpy as np
import pytest

from snakesfm.artifacts.hloc import (
    clashing_names,
    descriptor_size,
    open_hloc,
    read_hloc_features,
    read_hloc_matches,
    write_hloc_features,
    write_hloc_matches,
)
from snakesfm.errors import ConfigError


@pytest.fixture
def columns():
    rng = np.random.default_rng(0)
    return {
        "keypoints": rng.uniform(0, 4000, (7, 2)).astype(np.float32),
        "descriptors": rng.normal(size=(7, 16)).astype(np.float16),
        "scores": rng.uniform(size=7).astype(np.float32),
        "scales": rng.uniform(1, 9, 7).astype(np.float32),
        "angles": rng.uniform(-3, 3, 7).astype(np.float32),
    }


def test_features_survive_the_round_trip_and_are_in_hlocs_convention(tmp_path, columns):
    with h5py.File(tmp_path / "features.h5", "w") as file:
        write_hloc_features(file, "a/b 1.jpg", columns, (4000, 3000))
    file = open_hloc(tmp_path / "features.h5")
    group = file["a"]["b 1.jpg"]
    np.testing.assert_allclose(group["keypoints"][()], columns["keypoints"] - 0.5, atol=1e-3)
    assert group["descriptors"].shape == (16, 7) and group["image_size"][()].tolist() == [4000, 3000]
    found = read_hloc_features(file, "a/b 1.jpg")
    for name, column in columns.items():
        np.testing.assert_allclose(found[name], column, atol=2e-3)
        assert found[name].dtype == column.dtype
    assert descriptor_size(file) == 16
    assert read_hloc_features(file, "a") is None and read_hloc_features(file, "missing.jpg") is None


def test_half_precision_without_scores_or_descriptors_is_read(tmp_path):
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file.create_group("x.jpg")["keypoints"] = np.array([[1, 2], [3, 4]], np.float16)
    file = open_hloc(tmp_path / "features.h5")
    found = read_hloc_features(file, "x.jpg")
    np.testing.assert_array_equal(found["keypoints"], [[1.5, 2.5], [3.5, 4.5]])
    assert found["descriptors"].shape == (2, 0) and (found["scores"] == 1).all()
    assert descriptor_size(file) == 0


@pytest.mark.parametrize("joint", ["/", "_"])
@pytest.mark.parametrize("turned", [False, True])
def test_matches_are_found_whichever_way_they_are_stored(tmp_path, joint, turned):
    names = ("s/a.jpg", "b.jpg")
    stored = names[::-1] if turned else names
    expected = np.array([[0, 4], [2, 0], [5, 3]])
    partners = np.full(6, -1, np.int16)
    rows = expected[:, ::-1] if turned else expected
    partners[rows[:, 0]] = rows[:, 1]
    scores = np.zeros(6, np.float16)
    scores[rows[:, 0]] = [0.25, 0.5, 0.75]
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        group = file.create_group(joint.join(name.replace("/", "-") for name in stored))
        group["matches0"], group["matching_scores0"] = partners, scores
    matches, values = read_hloc_matches(open_hloc(tmp_path / "matches.h5"), names, (6, 6))
    np.testing.assert_array_equal(matches, expected)
    np.testing.assert_array_equal(values, [0.25, 0.5, 0.75])
    assert matches.dtype == np.int32


def test_matches_survive_the_round_trip(tmp_path):
    matches = np.array([[1, 7], [3, 0]], np.int32)
    with h5py.File(tmp_path / "matches.h5", "w") as file:
        write_hloc_matches(file, ("d/a.jpg", "b.jpg"), matches, np.array([0.5, 1.0]), 5)
    file = open_hloc(tmp_path / "matches.h5")
    assert list(file) == ["d-a.jpg"]
    found, scores = read_hloc_matches(file, ("d/a.jpg", "b.jpg"), (5, 8))
    np.testing.assert_array_equal(found, matches)
    np.testing.assert_array_equal(scores, [0.5, 1.0])
    assert read_hloc_matches(file, ("d/a.jpg", "c.jpg"), (5, 8)) is None


def test_files_that_do_not_fit_together_are_refused(tmp_path, columns):
    with h5py.File(tmp_path / "bad.h5", "w") as file:
        write_hloc_features(file, "a.jpg", columns, (9, 9))
        del file["a.jpg"]["scores"]
        file["a.jpg"]["scores"] = np.ones(3)
        write_hloc_matches(file, ("a.jpg", "b.jpg"), np.array([[0, 9]]), np.ones(1), 5)
    file = open_hloc(tmp_path / "bad.h5")
    with pytest.raises(ConfigError, match=r"7 keypoints of 'a\.jpg'"):
        read_hloc_features(file, "a.jpg")
    with pytest.raises(ConfigError, match="one run of hloc"):
        read_hloc_matches(file, ("a.jpg", "b.jpg"), (5, 9))
    with pytest.raises(ConfigError, match="imported=DIR"):
        open_hloc(tmp_path / "missing.h5")


def test_names_that_hloc_confuses_are_told():
    assert list(clashing_names(["a/b.jpg", "c.jpg", "a-b.jpg"])) == [("a/b.jpg", "a-b.jpg")]
    assert not list(clashing_names(["a/b.jpg", "a/c.jpg"]))
