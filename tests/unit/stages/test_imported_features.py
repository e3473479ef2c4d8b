"""Stage extract_features on hloc's files: of images of other sizes, and of shapes that other tools write."""

import cv2
import h5py
import numpy as np
import pytest
from plain_artifacts import write_plain_index

from snakesfm.artifacts import LocalFeatures
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.errors import ConfigError
from snakesfm.features.keypoints import KeypointSet
from snakesfm.matching.matcher import MATCHERS
from snakesfm.retrieval.vlad import describe_vlad
from snakesfm.stages import extract_features
from snakesfm.stages.job import StageJob

WIDTH, HEIGHT = 403, 302


@pytest.fixture
def extract(tmp_path):
    """Run the stage on arrays by image, for images of 403 x 302 pixels; the keypoints of each."""

    def run(arrays):
        names = sorted(arrays)
        rng = np.random.default_rng(0)
        for name in names:
            pixels = rng.integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
            cv2.imwrite(str(tmp_path / name), pixels)
        write_plain_index(tmp_path / "index.h5", names, [(WIDTH, HEIGHT)] * len(names))
        with h5py.File(tmp_path / "features.h5", "w") as file:
            for name, group in arrays.items():
                for key, values in group.items():
                    file[f"{name}/{key}"] = values
        output = tmp_path / "0.h5"
        extract_features.run(
            StageJob(
                stage="extract_features",
                scene="scene",
                inputs={"index": tmp_path / "index.h5"},
                outputs=(output,),
                options=ExtractFeaturesOptions(method="imported"),
                settings={"images": str(tmp_path), "imported": str(tmp_path), "block": 0},
            )
        )
        return LocalFeatures.read(output)

    return run


def keypoints(count=5, **changes):
    rng = np.random.default_rng(count)
    places = rng.uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (count, 2)).astype(np.float32)
    return {"keypoints": places, "descriptors": rng.normal(size=(16, count)).astype(np.float32)} | changes


@pytest.mark.parametrize("factor", [2, 0.5])
def test_keypoints_of_larger_or_smaller_photographs_are_scaled(extract, capsys, factor):
    seen = np.array([round(WIDTH * factor), round(HEIGHT * factor)])
    # edges map to edges, and hloc's first pixel has its centre at 0
    there = (keypoints()["keypoints"] + 0.5) * (seen / [WIDTH, HEIGHT]) - 0.5
    scaled = keypoints(keypoints=there, scales=np.full(5, 4.0 * factor), image_size=seen)
    found = extract({"a.png": scaled, "b.png": scaled, "c.png": keypoints(image_size=[WIDTH, HEIGHT])})
    for image in range(3):
        part = slice(5 * image, 5 * image + 5)
        np.testing.assert_allclose(found.keypoints[part], keypoints()["keypoints"] + 0.5, atol=2e-3)
    np.testing.assert_allclose(found.scales, [*[4.0] * 10, *[1.0] * 5], rtol=5e-3)
    said = [line for line in capsys.readouterr().out.splitlines() if "are scaled" in line]
    assert len(said) == 1
    assert f"'a.png' had {seen[0]} x {seen[1]} pixels and has {WIDTH} x {HEIGHT}" in said[0]


@pytest.mark.parametrize("seen", [(HEIGHT, WIDTH), (WIDTH, HEIGHT - 10), (2 * WIDTH, HEIGHT)])
def test_keypoints_of_a_photograph_with_another_aspect_are_refused(extract, seen):
    words = rf"'a\.png' from an image of {seen[0]} x {seen[1]} pixels, but .* has {WIDTH} x {HEIGHT}"
    with pytest.raises(ConfigError, match=words):
        extract({"a.png": keypoints(image_size=seen)})


@pytest.mark.parametrize("seen", [[0, 0], [WIDTH], [np.nan, 10]])
def test_an_image_size_that_is_none_is_refused(extract, seen):
    with pytest.raises(ConfigError, match=r"image_size for 'a\.png' that is not a width"):
        extract({"a.png": keypoints(image_size=seen)})


def test_images_without_descriptors_or_keypoints_go_with_the_others(extract, capsys):
    bare = {"keypoints": keypoints(4)["keypoints"]}
    nothing = {"keypoints": np.zeros((0, 2)), "descriptors": np.zeros(0)}
    found = extract({"a.png": bare, "b.png": keypoints(), "c.png": nothing})
    assert found.offsets.tolist() == [0, 4, 9, 9] and found.descriptors.shape == (9, 16)
    assert not found.descriptors[:4].any()
    np.testing.assert_allclose(found.descriptors[4:], keypoints()["descriptors"].T, atol=1e-2)
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert len(warnings) == 1 and "has no descriptors for 'a.png'" in warnings[0]


def test_descriptors_of_two_lengths_are_refused(extract):
    other = keypoints(descriptors=np.ones((32, 5)))
    with pytest.raises(ConfigError, match=r"of length 32 for 'b\.png', but of 16 for other images"):
        extract({"a.png": keypoints(), "b.png": other})


def test_descriptors_that_are_not_finite_become_zeros_and_harm_neither_matching_nor_retrieval(
    extract, capsys
):
    rng = np.random.default_rng(1)
    own = rng.normal(size=(16, 300))
    broken = own + rng.normal(scale=0.01, size=own.shape)
    # the last is too large for half precision
    broken[3, 5], broken[:, 7], broken[0, 11] = np.nan, np.inf, 1e6
    places = np.tile([[9.0, 9.0]], (300, 1))
    found = extract(
        {
            "a.png": {"keypoints": places, "descriptors": own},
            "b.png": {"keypoints": places, "descriptors": broken},
        }
    )
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning")]
    assert len(warnings) == 1 and "3 of 300 descriptors of 'b.png' are not finite" in warnings[0]
    first, second = found.descriptors[:300], found.descriptors[300:]
    assert np.flatnonzero(~second.any(axis=1)).tolist() == [5, 7, 11] and np.isfinite(second).all()
    assert first.dtype == np.float16
    whole = [row for row in range(300) if row not in (5, 7, 11)]
    for one, other in ((first, second), (second, first)):
        matcher = MATCHERS["mutual_ratio"](max_ratio=0.8, words=32, probes=3.0)
        prepared = [
            KeypointSet(places, rows, places[:, 0], places[:, 0], places[:, 0]) for rows in (one, other)
        ]
        matches, _ = matcher.match(matcher.prepare(prepared[0]), matcher.prepare_second(prepared[1]))
        same = matches[:, 0] == matches[:, 1]
        assert set(matches[same, 0].tolist()) == set(whole) and (~same).sum() <= 3
    centers = first[:8].astype(np.float32)
    vectors = [describe_vlad(rows, centers, 0.5) for rows in (first, second)]
    assert 0.9 < vectors[0] @ vectors[1] <= 1.001
