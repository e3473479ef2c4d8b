"""hloc's files: what is written is read again, and what other versions of hloc write is read too."""

import h5py
import numpy as np
import pytest

from snakesfm.artifacts.hloc import (
    clashing_names,
    descriptor_size,
    estimate_hloc_pairs,
    open_hloc,
    read_hloc_features,
    read_hloc_matches,
    read_hloc_pairs,
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


def test_descriptors_of_whole_numbers_get_length_1(tmp_path, columns):
    columns["descriptors"] = np.random.default_rng(1).integers(0, 256, (7, 128)).astype(np.uint8)
    columns["descriptors"][3] = 0
    with h5py.File(tmp_path / "features.h5", "w") as file:
        write_hloc_features(file, "a.jpg", columns, (9, 9))
    file = open_hloc(tmp_path / "features.h5")
    lengths = np.linalg.norm(file["a.jpg"]["descriptors"][()].astype(np.float64), axis=0)
    np.testing.assert_allclose(lengths, np.arange(7) != 3, atol=1e-3)
    found = read_hloc_features(file, "a.jpg")["descriptors"]
    norms = np.linalg.norm(columns["descriptors"].astype(float), axis=1, keepdims=True)
    np.testing.assert_allclose(found, columns["descriptors"] / np.maximum(norms, 1.0), atol=1e-3)


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
    with pytest.raises(ConfigError, match=r"7 keypoints for 'a\.jpg'"):
        read_hloc_features(file, "a.jpg")
    with pytest.raises(ConfigError, match="the same run of hloc"):
        read_hloc_matches(file, ("a.jpg", "b.jpg"), (5, 9))
    with pytest.raises(ConfigError, match="imported=DIR"):
        open_hloc(tmp_path / "missing.h5")


def test_names_that_hloc_confuses_are_told():
    assert list(clashing_names(["a/b.jpg", "c.jpg", "a-b.jpg"])) == [("a/b.jpg", "a-b.jpg")]
    assert not list(clashing_names(["a/b.jpg", "a/c.jpg"]))


def write(path, group, **arrays):
    with h5py.File(path, "a") as file:
        for key, values in arrays.items():
            file[f"{group}/{key}"] = values
    return open_hloc(path)


def test_keypoints_may_have_the_columns_of_colmap(tmp_path):
    rows = np.arange(18, dtype=np.float32).reshape(3, 6) / 8
    for columns in (2, 3, 4, 6):
        file = write(tmp_path / f"{columns}.h5", "a.jpg", keypoints=rows[:, :columns])
        found = read_hloc_features(file, "a.jpg")
        np.testing.assert_array_equal(found["keypoints"], rows[:, :2] + 0.5)
        np.testing.assert_array_equal(found["scales"], rows[:, 2] if columns == 4 else np.ones(3))
        np.testing.assert_array_equal(found["angles"], rows[:, 3] if columns == 4 else np.zeros(3))
    named = {"scales": np.full(3, 7.0), "oris": np.full(3, 90.0)}
    found = read_hloc_features(write(tmp_path / "own.h5", "a.jpg", keypoints=rows[:, :4], **named), "a.jpg")
    np.testing.assert_allclose(found["scales"], 7)
    np.testing.assert_allclose(found["angles"], np.pi / 2, rtol=1e-6)


@pytest.mark.parametrize("shape", [(6,), (1, 3, 2), (5, 1), (2, 7)])
def test_keypoints_that_are_no_rows_of_coordinates_are_refused(tmp_path, shape):
    file = write(tmp_path / "f.h5", "a.jpg", keypoints=np.zeros(shape))
    with pytest.raises(ConfigError, match=r"keypoints of shape .* for 'a\.jpg', which are not rows"):
        read_hloc_features(file, "a.jpg")


@pytest.mark.parametrize("shape", [(0,), (0, 16), (16, 0)])
@pytest.mark.parametrize("none", [(0,), (0, 2), (0, 4)])
def test_an_image_without_keypoints_is_read_whatever_shape_its_descriptors_have(tmp_path, none, shape):
    path = tmp_path / "f.h5"
    write(path, "a.jpg", keypoints=np.zeros(none), descriptors=np.zeros(shape), scores=np.zeros(0))
    file = write(path, "b.jpg", keypoints=np.zeros((3, 2)), descriptors=np.zeros((16, 3)))
    found = read_hloc_features(file, "a.jpg")
    assert found["keypoints"].shape == (0, 2) and found["descriptors"].shape == (0, 0)
    assert all(len(column) == 0 for column in found.values())
    assert descriptor_size(file) == 16


@pytest.mark.parametrize("shape", [(3,), (3, 16), (16, 0), (1, 16, 3)])
def test_descriptors_that_are_not_one_per_keypoint_are_refused(tmp_path, shape):
    file = write(tmp_path / "f.h5", "a.jpg", keypoints=np.zeros((3, 2)), descriptors=np.zeros(shape))
    with pytest.raises(ConfigError, match=r"3 keypoints for 'a\.jpg', but another number of descriptors"):
        read_hloc_features(file, "a.jpg")


def test_matches_with_a_leading_axis_are_read_and_too_few_scores_refused(tmp_path):
    partners, scores = np.array([[-1, 2, 0]]), np.array([[0, 0.5, 0.25]])
    path = tmp_path / "m.h5"
    write(path, "a.jpg/b.jpg", matches0=partners, matching_scores0=scores)
    file = write(path, "a.jpg/c.jpg", matches0=partners, matching_scores0=scores[:, :2])
    matches, values = read_hloc_matches(file, ("a.jpg", "b.jpg"), (3, 3))
    assert matches.tolist() == [[1, 2], [2, 0]] and values.tolist() == [0.5, 0.25]
    with pytest.raises(ConfigError, match=r"3 matches0 for 'a\.jpg' and 'c\.jpg', but 2 matching_scores0"):
        read_hloc_matches(file, ("a.jpg", "c.jpg"), (3, 3))


@pytest.mark.parametrize("joint", ["/", "_"])
def test_pairs_are_those_that_the_matches_are_of(tmp_path, joint):
    names = ["s/a_1.jpg", "b.jpg", "b_2.jpg", "s-a_1.jpg", "c.jpg"]
    stored = [("s-a_1.jpg", "b_2.jpg"), ("c.jpg", "b.jpg"), ("b.jpg", "b_2.jpg"), ("b.jpg", "gone_3.jpg")]
    path = tmp_path / "matches.h5"
    with h5py.File(path, "w") as file:
        for pair in stored:
            file[f"{joint.join(pair)}/matches0"] = np.array([0])
            file[f"{joint.join(pair)}/matching_scores0"] = np.array([1.0])
        file["notes"] = np.zeros(3)
    file = open_hloc(path)
    pairs, others = read_hloc_pairs(file, names)
    # two images have one name in hloc's files, which cannot tell whose matches these are
    assert sorted(map(tuple, pairs.tolist())) == [(0, 2), (1, 2), (3, 2), (4, 1)] and others == 1
    assert all(read_hloc_matches(file, (names[i], names[j]), (1, 1)) is not None for i, j in pairs)
    assert 3 <= estimate_hloc_pairs(file) <= 6
    assert len(read_hloc_pairs(file, ["x.jpg"])[0]) == 0


@pytest.mark.parametrize("joint", ["/", "_"])
def test_the_number_of_pairs_is_estimated_from_some(tmp_path, joint):
    with h5py.File(tmp_path / "matches.h5", "w", libver="latest") as file:
        for i in range(300):
            for j in range(i + 1, min(i + 1 + i % 11, 300)):
                file[joint.join((f"{i:03}.jpg", f"{j:03}.jpg")) + "/matches0"] = np.zeros(1, np.int8)
        pairs, _ = read_hloc_pairs(file, [f"{i:03}.jpg" for i in range(300)])
        assert len(pairs) == 1470
        assert 1300 < estimate_hloc_pairs(file) < 1650
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        assert estimate_hloc_pairs(file) == 0 and read_hloc_pairs(file, ["a", "b"])[1] == 0
