"""From images to matches where images are damaged, copied, masked or none, and former files damaged."""

import io

import cv2
import h5py
import numpy as np
import pytest
from extras import import_extra
from image_stages import NAMES, Scene
from random_weights import write_netvlad

from snakesfm.artifacts import GlobalDescriptors, LocalFeatures
from snakesfm.blocks import deal_blocks
from snakesfm.cache import cached_path, share
from snakesfm.config.describe_images import DescribeImagesOptions
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.learn_vocabulary import LearnVocabularyOptions
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.errors import ConfigError
from snakesfm.stages import describe_images, extract_features, learn_vocabulary


def test_one_bad_image_is_a_warning(images, tmp_path, capsys):
    scene = Scene(tmp_path, images, 1)
    scene.terminal = io.StringIO()
    scene.extract()
    lines = capsys.readouterr().out.splitlines()
    warnings = [line for line in lines if line.startswith("warning")]
    assert len(warnings) == 1 and "gone.png" in warnings[0]
    assert lines[-1].startswith("6 images (0 taken over)")
    (said,) = scene.terminal.getvalue().splitlines()
    assert said.startswith("snakesfm: scene 'scene': warning: 2 of 6 images have no keypoints")
    assert "'flat.png'" in said


def test_a_picture_that_cannot_be_read_resembles_none(images, tmp_path):
    import_extra("torch")
    scene = Scene(tmp_path, images, 1)
    scene.terminal = io.StringIO()
    write_netvlad(tmp_path / "netvlad_pitts30k.mat")
    told = {"images": str(images), "block": 0, "weights": str(tmp_path), "models": ["netvlad"], "fetch": ""}
    output = scene.file("descriptors")
    inputs = {"index": [scene.file("index")]}
    options = DescribeImagesOptions(method="netvlad")
    describe_images.run(scene.job("describe_images", options, inputs, [output], **told))
    lengths = np.linalg.norm(GlobalDescriptors.read(output).descriptors, axis=1)
    np.testing.assert_allclose(lengths[[0, 1, 3, 4, 5]], [1, 1, 0, 1, 1], atol=1e-3)
    assert "warning: 1 of 6 images cannot be read" in scene.terminal.getvalue()


def test_copies_of_an_image_are_left_out_but_where_a_list_names_them(images, tmp_path):
    scene = Scene(tmp_path / "copies", images, 2, copies=(1, 5))
    scene.extract()
    options = SelectPairsOptions(preview_keypoints=0, method="exhaustive")
    pairs = {pair for pair, *_ in scene.select(options)}
    assert pairs == {(i, j) for i in range(6) for j in range(i + 1, 6) if not {1, 5} & {i, j}}
    # a copy takes no place among the neighbours
    scene.describe()
    for changes in ({"method": "sequential", "look_ahead": 1}, {"method": "retrieval", "top_k": 1}):
        pairs = {pair for pair, *_ in scene.select(options.model_copy(update=changes))}
        assert (0, 2) in pairs if "look_ahead" in changes else {0, 4} <= set(sum(pairs, ()))
        assert not {1, 5} & set(sum(pairs, ()))
    path = tmp_path / "pairs.txt"
    path.write_text(f"{NAMES[0]} {NAMES[1]}\n", "utf-8")
    assert [pair for pair, *_ in scene.select(SelectPairsOptions(method="listed"), str(path))] == [(0, 1)]


def test_neighbours_by_gps_are_those_on_the_ground(tmp_path):
    gps = np.array([[47.0, 8.0 + 1e-4 * k, 400.0 * (k % 2)] for k in range(6)])
    gps[2, 2], gps[5] = np.nan, np.nan
    scene = Scene(tmp_path, tmp_path, 2, gps=gps)
    scene.terminal = io.StringIO()
    rows = scene.select(SelectPairsOptions(method="spatial", preview_keypoints=0, top_k=1))
    by_place = {pair for pair, reason, *_ in rows if reason == "spatial"}
    assert {(0, 1), (3, 4)} <= by_place <= {(a, a + 1) for a in range(4)}
    # the image without a position is the last by name
    assert {(pair, reason) for pair, reason, *_ in rows if reason != "spatial"} == {((4, 5), "sequential")}
    assert "warning: 1 of 6 images have no GPS" in scene.terminal.getvalue()
    both = scene.select(
        SelectPairsOptions(method="sequential+spatial", preview_keypoints=0, top_k=2, look_ahead=1)
    )
    assert {"sequential", "sequential+spatial", "spatial"} >= {reason for _, reason, *_ in both}
    assert {(4, 5), (0, 2)} <= {pair for pair, *_ in both}


@pytest.mark.parametrize("damage", ["columns", "attributes", "groups", "pages"])
def test_a_damaged_former_or_shared_file_costs_time_alone(images, tmp_path, capsys, monkeypatch, damage):
    """What h5py raises is of many kinds."""
    monkeypatch.setenv("SNAKESFM_CACHE", str(tmp_path / "shared"))
    scene = Scene(tmp_path, images, 1)
    scene.extract()
    (made,) = scene.block_files("features")
    digests = LocalFeatures.read(made).digests
    whole = made.read_bytes()
    cached = cached_path("extract_features", digests)
    former = tmp_path / "former.h5"
    former.write_bytes(whole)
    if damage == "pages":
        former.write_bytes(whole[:2000] + b"\xff" * 3000 + whole[5000:])
    else:
        with h5py.File(former, "r+") as file:
            if damage == "attributes":
                file.attrs["checksum"] = "none"
            elif damage == "columns":
                del file["offsets"]
                file["offsets"] = np.arange(3, dtype=float)
            else:
                del file["digests"]
                file.create_group("digests")
    cached.parent.mkdir(parents=True)
    cached.write_bytes(former.read_bytes())
    options = ExtractFeaturesOptions(max_keypoints=400)
    settings = {"images": str(images), "block": 0}
    inputs, again = {"index": scene.file("index")}, tmp_path / "again.h5"
    capsys.readouterr()
    job = scene.job("extract_features", options, inputs, [again], former, **settings)
    extract_features.run(job)
    assert "6 images (0 taken over)" in capsys.readouterr().out
    # it may be an intact one that this job alone could not read
    assert cached.exists()
    np.testing.assert_array_equal(LocalFeatures.read(again).keypoints, LocalFeatures.read(made).keypoints)
    share(again, cached, replace=cached in job.distrusted)
    extract_features.run(scene.job("extract_features", options, inputs, [made], None, **settings))
    assert "6 images (6 taken over)" in capsys.readouterr().out
    assert cached.exists()


def test_what_is_shared_already_stays_unless_it_is_damaged(tmp_path, capsys):
    """Also of another size, as the names of scenes in the header make it."""
    made, cached = tmp_path / "made.h5", tmp_path / "shared" / "cached.h5"
    made.write_bytes(b"made here")
    cached.parent.mkdir()
    cached.write_bytes(b"made in another scene")
    share(made, cached)
    assert cached.read_bytes() == b"made in another scene"
    share(made, cached, replace=True)
    assert cached.read_bytes() == b"made here"
    assert list(cached.parent.iterdir()) == [cached]
    assert capsys.readouterr().out == ""


def test_an_empty_scene_gives_valid_files(tmp_path, images):
    scene = Scene(tmp_path, images, 40)
    empty = next(block for block in range(40) if block not in deal_blocks(NAMES, 40))
    inputs = {"index": scene.file("index")}
    output = scene.block_files("features")[empty]
    extract_features.run(
        scene.job(
            "extract_features",
            ExtractFeaturesOptions(),
            inputs,
            [output],
            images=str(images),
            block=empty,
        )
    )
    assert LocalFeatures.read(output).descriptors.shape == (0, 128)
    scene.job("learn_vocabulary", LearnVocabularyOptions(), {"features": [output]}, [scene.file("v")])
    learn_vocabulary.run(
        scene.job("learn_vocabulary", LearnVocabularyOptions(), {"features": [output]}, [scene.file("v")])
    )
    describe_images.run(
        scene.job(
            "describe_images",
            DescribeImagesOptions(),
            {"features": output, "vocabulary": scene.file("v")},
            [scene.file("d")],
        )
    )
    assert len(GlobalDescriptors.read(scene.file("d")).image_ids) == 0


def test_keypoints_are_found_where_masks_want_them(images, tmp_path):
    masks = tmp_path / "masks"
    (masks / "a").mkdir(parents=True)
    # the left quarter, in a mask of half the image's size
    quarter = np.zeros((120, 160), np.uint8)
    quarter[:, :40] = 255
    cv2.imwrite(str(masks / "a" / "1 #{x}.png.png"), quarter)
    cv2.imwrite(str(masks / "other.png"), np.zeros((240, 320), np.uint8))
    cv2.imwrite(str(masks / "flat.png.png"), np.full((240, 320), 255, np.uint8))
    found, keypoints = {}, {}
    options = ExtractFeaturesOptions(max_keypoints=60)
    for name, settings in (("all", {}), ("masked", {"masks": str(masks)})):
        (tmp_path / name).mkdir()
        scene = Scene(tmp_path / name, images, 1)
        scene.extract(options, **settings)
        found[name] = LocalFeatures.read(scene.block_files("features")[0])
        keypoints[name] = np.split(found[name].keypoints, found[name].offsets[1:-1])
    left, hidden = NAMES.index("a/1 #{x}.png"), NAMES.index("other.png")
    assert keypoints["all"][left][:, 0].max() > 200
    assert 40 < keypoints["masked"][left][:, 0].max() < 80
    # as many as are wanted are found in the part that is left
    assert len(keypoints["masked"][left]) == len(keypoints["all"][left]) == 60
    assert len(keypoints["masked"][hidden]) == 0 < len(keypoints["all"][hidden])
    for name in ("b/ü 2.png", "shifted.png"):
        row = NAMES.index(name)
        np.testing.assert_array_equal(keypoints["masked"][row], keypoints["all"][row])
    changed = found["masked"].digests != found["all"].digests
    assert {NAMES[row] for row in np.flatnonzero(changed)} == {"a/1 #{x}.png", "other.png", "flat.png"}


def test_a_mask_of_another_shape_is_refused(images, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / "other.png.png"), np.zeros((320, 240), np.uint8))
    scene = Scene(tmp_path, images, 1)
    with pytest.raises(ConfigError, match=r"other\.png\.png has 240 x 320 pixels, but its image 320 x 240"):
        scene.extract(masks=str(masks))
    (masks / "other.png.png").write_bytes(b"\x89PNG no image")
    with pytest.raises(ConfigError, match=r"A mask cannot be used: .*other\.png\.png"):
        scene.extract(masks=str(masks))
