"""From images to matches by the stages themselves, on rendered images."""

import io
import shutil

import cv2
import h5py
import numpy as np
import pytest
from image_stages import NAMES, SHIFT, Scene

from snakesfm.artifacts import GlobalDescriptors, Header, LocalFeatures, Vocabulary
from snakesfm.blocks import deal_blocks
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.errors import ConfigError
from snakesfm.ingest.indexed import IndexedImages
from snakesfm.matching.matcher import MutualRatioMatcher
from snakesfm.retrieval.rounding import round_units
from snakesfm.stages import match_pairs


@pytest.fixture(scope="module")
def whole(tmp_path_factory, images):
    scene = Scene(tmp_path_factory.mktemp("whole"), images, 1)
    scene.extract()
    scene.describe()
    return scene


@pytest.fixture(scope="module")
def dealt(tmp_path_factory, images):
    scene = Scene(tmp_path_factory.mktemp("dealt"), images, 3)
    scene.extract()
    scene.describe()
    return scene


def test_features_do_not_depend_on_the_blocks(whole, dealt):
    one, many = whole.features(), dealt.features()
    assert sorted(one) == sorted(many) == sorted(NAMES)
    for name in NAMES:
        for column, values in one[name].items():
            np.testing.assert_array_equal(values, many[name][column])
    counts = [len(one[name]["keypoints"]) for name in NAMES]
    assert counts[2] == counts[3] == 0 and min(counts[0], counts[1], counts[4], counts[5]) > 100


def test_colors_are_those_of_the_image(whole, images):
    found = whole.features()["other.png"]
    picture = cv2.imread(str(images / "other.png"))[..., ::-1]
    assert np.ptp(picture.astype(int), axis=2).mean() > 50
    columns, rows = np.floor(found["keypoints"]).astype(int).T
    np.testing.assert_array_equal(found["colors"], picture[rows, columns])


def test_vocabulary_and_pairs_do_not_depend_on_the_blocks(whole, dealt):
    np.testing.assert_array_equal(
        Vocabulary.read(whole.file("vocabulary")).centers, Vocabulary.read(dealt.file("vocabulary")).centers
    )
    options = SelectPairsOptions(method="sequential+retrieval", look_ahead=1, top_k=2)
    assert str(whole.select(options)) == str(dealt.select(options))


def test_retrieval_prefers_what_overlaps(dealt):
    rows = dealt.select(SelectPairsOptions(method="retrieval", top_k=1, min_score=0.0))
    pairs = {pair for pair, *_ in rows}
    assert pairs & {(0, 1), (0, 5), (1, 5)}
    assert not any(2 in pair or 3 in pair for pair in pairs)
    assert all(0 < similarity <= 1.001 for _, _, similarity, _ in rows)
    vectors = GlobalDescriptors.read(dealt.block_files("descriptors")[0]).descriptors
    assert vectors.shape[1] == 8 * 128


def test_a_sequence_is_searched_for_similar_images_of_other_times(tmp_path, images):
    scene = Scene(tmp_path, images, 2)
    # the second and third image are nearly the first one, the last one shows the same place again
    angles = np.radians([0, 4, 8, 40, 60, 20])
    vectors = round_units(np.column_stack([np.cos(angles), np.sin(angles)]))
    dealt = np.array(deal_blocks(NAMES, 2))
    for block, path in enumerate(scene.block_files("descriptors")):
        rows = np.flatnonzero(dealt == block)
        descriptors = GlobalDescriptors(image_ids=rows, descriptors=vectors[rows])
        descriptors.write(path, Header("describe_images", 1, "scene"))

    def retrieved(method):
        options = SelectPairsOptions(method=method, look_ahead=1, top_k=2, preview_keypoints=0)
        return {pair for pair, reason, *_ in scene.select(options) if "retrieved" in reason}

    assert {(0, 1), (0, 5)} <= retrieved("sequential+retrieval")
    # without an order of names the most similar ones are all that counts
    assert (0, 2) in retrieved("retrieval") and (0, 5) not in retrieved("retrieval")


def test_auto_takes_all_pairs_of_few_images(dealt):
    rows = dealt.select(SelectPairsOptions())
    assert [pair for pair, *_ in rows] == [(i, j) for i in range(6) for j in range(i + 1, 6)]
    assert {reason for _, reason, *_ in rows} == {"exhaustive"}


def test_pairs_are_looked_at_and_what_shares_nothing_is_left(dealt, whole):
    options = SelectPairsOptions(preview_keypoints=100, min_likeness=0.0)
    rows = dealt.select(options)
    assert str(rows) == str(whole.select(options))
    likenesses = {pair: likeness for pair, *_, likeness in rows}
    overlapping = {(0, 1), (0, 5), (1, 5)}
    # two images have too few keypoints to tell strangers by
    assert np.isfinite([*likenesses.values()]).all()
    strangers = [likenesses[pair] for pair in likenesses if 4 in pair and not {2, 3} & {*pair}]
    least = min(likenesses[pair] for pair in overlapping)
    assert len(strangers) == 3 and max(strangers) < 1.5 < least
    strict = options.model_copy(update={"min_likeness": 1.5, "least_partners": 0})
    assert {pair for pair, *_ in dealt.select(strict) if not {2, 3} & {*pair}} == overlapping
    lenient = {pair for pair, *_ in dealt.select(strict.model_copy(update={"least_partners": 1}))}
    assert len([pair for pair in lenient if 4 in pair and not {2, 3} & {*pair}]) == 1
    fewest = options.model_copy(update={"enough_partners": 1, "enough_likeness": 0.0})
    kept = {pair for pair, *_ in dealt.select(fewest) if not {2, 3} & {*pair}}
    # each of four images keeps one
    assert 2 <= len(kept) <= 4 and max(overlapping, key=likenesses.get) in kept


def test_a_list_is_followed(dealt, tmp_path, monkeypatch):
    path = tmp_path / "my pairs.txt"
    path.write_text("\ufeffb/ü 2.png a/1 #{x}.png\nother.png bad.jpg\n", "utf-8")
    terminal = io.StringIO()
    monkeypatch.setattr(dealt, "terminal", terminal)
    rows = dealt.select(SelectPairsOptions(), str(path))
    assert f"warning: 1 pairs of '{path}' are left out" in terminal.getvalue()
    assert [(pair, reason) for pair, reason, *_ in rows] == [((0, 1), "listed")]
    path.write_text("b/ü 2.png nobody.png\n", "utf-8")
    with pytest.raises(ConfigError, match=r"my pairs.txt:1.*nobody"):
        dealt.select(SelectPairsOptions(), str(path))
    with pytest.raises(ConfigError, match="pairs=FILE"):
        dealt.select(SelectPairsOptions(method="listed"))
    with pytest.raises(ConfigError, match="cannot be read"):
        dealt.select(SelectPairsOptions(method="listed"), str(tmp_path / "missing.txt"))


def test_the_pairs_of_a_file_of_matches_are_followed(dealt, tmp_path, capsys):
    path = tmp_path / "matches.h5"
    with h5py.File(path, "w") as file:
        for pair in ("b-ü 2.png/a-1 #{x}.png", "a-1 #{x}.png/b-ü 2.png", "flat.png_gone.png", "bad.jpg/x"):
            file[f"{pair}/matches0"] = np.array([-1])
    rows = dealt.select(SelectPairsOptions(exhaustive_up_to=2), str(path))
    assert [(pair, reason) for pair, reason, *_ in rows] == [((0, 1), "listed"), ((2, 3), "listed")]
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("warning: 1 pairs of") and "matches.h5" in line]
    with h5py.File(path, "w") as file:
        file["images/a/1.png/matches0"] = np.array([-1])
    with pytest.raises(
        ConfigError, match=r"matches\.h5' has no matches between images of this scene \(1 pairs"
    ):
        dealt.select(SelectPairsOptions(), str(path))
    path.write_bytes(b"no HDF5 file")
    with pytest.raises(ConfigError, match="not an HDF5 file"):
        dealt.select(SelectPairsOptions(), str(path))


def test_without_gps_there_are_no_neighbours_by_it(dealt):
    with pytest.raises(ConfigError, match=r"EXIF.*sequential[+]retrieval"):
        dealt.select(SelectPairsOptions(method="spatial"))


def test_matches_are_right_and_do_not_depend_on_the_blocks(whole, dealt):
    whole.select(SelectPairsOptions())
    dealt.select(SelectPairsOptions())
    one, many = whole.match(), dealt.match()
    assert one.keys() == many.keys()
    for pair in one:
        np.testing.assert_array_equal(one[pair][0], many[pair][0])
        assert one[pair][2] == many[pair][2]
    points = whole.features()
    matches, scores, _ = one[0, 1]
    offset = points[NAMES[0]]["keypoints"][matches[:, 0]] - points[NAMES[1]]["keypoints"][matches[:, 1]]
    error = np.linalg.norm(offset - SHIFT, axis=1)
    assert len(matches) > 80 and (error < 1).mean() > 0.97 and 1e-4 < np.median(error) < 0.1
    assert ((scores >= 0.2 - 1e-6) & (scores <= 1)).all()
    assert len(one[0, 4][0]) < 12 and len(one[0, 2][0]) == len(one[2, 3][0]) == 0


def test_each_first_image_of_a_tile_is_prepared_once(whole, monkeypatch):
    whole.select(SelectPairsOptions())
    prepared = []
    original = MutualRatioMatcher.prepare
    monkeypatch.setattr(
        MutualRatioMatcher,
        "prepare",
        lambda self, first: prepared.append(first.image_name) or original(self, first),
    )
    # fewer than a first image has partners
    monkeypatch.setattr(match_pairs, "HELD_IMAGES", 2)
    assert len(whole.match()) == 15
    assert prepared == NAMES[:5]


def test_unchanged_images_and_pairs_are_taken_over(dealt, images, tmp_path, monkeypatch, capsys):
    dealt.select(SelectPairsOptions())
    before = dealt.match()
    changed = shutil.copytree(images, tmp_path / "images")
    with (changed / "other.png").open("ab") as file:
        file.write(b"behind the image")
    scene = Scene(tmp_path, changed, 3)
    read = []
    original = IndexedImages.read
    monkeypatch.setattr(
        IndexedImages, "read", lambda self, row, side: read.append(NAMES[row]) or original(self, row, side)
    )
    scene.extract(former=dealt)
    assert read == ["other.png"]
    scene.select(SelectPairsOptions())
    capsys.readouterr()
    after = scene.match(former=dealt)
    lines = capsys.readouterr().out.splitlines()
    assert sum(int(line.split("(")[1].split()[0]) for line in lines) == 10
    for pair in before:
        np.testing.assert_array_equal(before[pair][0], after[pair][0])
        np.testing.assert_array_equal(before[pair][1], after[pair][1])
        assert (before[pair][2] == after[pair][2]) == (4 not in pair)


def test_other_options_or_a_damaged_former_file_take_nothing_over(dealt, images, tmp_path, capsys):
    scene = Scene(tmp_path, images, 3)
    scene.extract(ExtractFeaturesOptions(max_keypoints=100), former=dealt)
    assert "(0 taken over)" in capsys.readouterr().out
    for path in scene.block_files("features"):
        path.write_bytes(b"damaged")
    other = Scene(tmp_path / "again", images, 3)
    other.extract(former=scene)
    assert all(len(points["keypoints"]) <= 400 for points in other.features().values())


@pytest.mark.parametrize("options", [{"contrast_threshold": 0.1}, {"edge_threshold": 1.3}])
def test_stricter_thresholds_find_fewer_keypoints(whole, images, tmp_path, options):
    scene = Scene(tmp_path, images, 1)
    scene.extract(ExtractFeaturesOptions(max_keypoints=400, **options))
    found, usual = (len(stage.features()["other.png"]["keypoints"]) for stage in (scene, whole))
    assert 10 < found < 0.9 * usual


def newer(kind, **options):
    """The options of a version to come."""
    return type("Newer", (kind,), {"stage_version": 999})(**options)


def test_features_and_matches_of_another_version_are_not_taken_over(dealt, images, tmp_path):
    scene = Scene(tmp_path, images, 3)
    scene.extract(newer(ExtractFeaturesOptions, max_keypoints=400), former=dealt)
    for before, after in zip(dealt.block_files("features"), scene.block_files("features"), strict=True):
        former, digests = (set(LocalFeatures.read(path).digests) for path in (before, after))
        assert len(former) == len(digests) > 0 and former.isdisjoint(digests)
    dealt.select(SelectPairsOptions(method="sequential", preview_keypoints=0, look_ahead=1))
    matches = (dealt.match(), dealt.match(newer(MatchPairsOptions), former=dealt))
    former, digests = ({row[2] for row in found.values()} for found in matches)
    assert len(former) == len(digests) == 5 and former.isdisjoint(digests)
