"""From images to matches by the stages themselves, on rendered images."""

import io
import shutil

import cv2
import h5py
import numpy as np
import pytest
from random_weights import write_netvlad

from snakesfm.artifacts import (
    GlobalDescriptors,
    Header,
    ImageIndex,
    ImagePairs,
    LocalFeatures,
    PairMatches,
    Vocabulary,
)
from snakesfm.blocks import deal_blocks
from snakesfm.cache import cached_path, share
from snakesfm.config.describe_images import DescribeImagesOptions
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.learn_vocabulary import LearnVocabularyOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.errors import ConfigError
from snakesfm.geometry.camera import PARAM_SLOTS
from snakesfm.ingest.discover import digest_images
from snakesfm.ingest.indexed import IndexedImages
from snakesfm.matching.matcher import MutualRatioMatcher
from snakesfm.stages import describe_images, extract_features, learn_vocabulary, match_pairs, select_pairs
from snakesfm.stages.job import StageJob

NAMES = ["a/1 #{x}.png", "b/ü 2.png", "flat.png", "gone.png", "other.png", "shifted.png"]
SHIFT = (23, 7)


def texture(seed, height=240, width=320):
    rng = np.random.default_rng(seed)
    image = cv2.resize(rng.uniform(0, 255, (30, 40)), (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(160):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        size = int(rng.integers(3, 15))
        cv2.rectangle(image, (x, y), (x + size, y + size), float(rng.uniform(0, 255)), -1)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 1.2), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    wide = texture(1, 260, 360)
    pictures = {
        "a/1 #{x}.png": wide[:240, :320],
        "b/ü 2.png": wide[SHIFT[1] : 240 + SHIFT[1], SHIFT[0] : 320 + SHIFT[0]],
        "flat.png": np.full((240, 320), 128, np.uint8),
        "other.png": texture(2),
        "shifted.png": wide[4:244, 12:332],
    }
    noise = np.random.default_rng(5)
    for name, picture in pictures.items():
        path = folder / name
        if name != "flat.png":
            picture = np.clip(picture + noise.normal(scale=2, size=picture.shape), 0, 255).astype(np.uint8)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
    (folder / "gone.png").write_bytes(b"\x89PNG no image")
    return folder


class Scene:
    """The stages from index to matches, in one folder, with a number of blocks."""

    terminal = None

    def __init__(self, folder, images, blocks, gps=None, copies=()):
        self.folder, self.images, self.blocks = folder, images, blocks
        count = len(NAMES)
        index = ImageIndex(
            names=NAMES,
            sizes=np.tile([320, 240], (count, 1)),
            sha256=list(digest_images(images, NAMES).values()),
            blocks=deal_blocks(NAMES, blocks),
            camera_ids=np.zeros(count, int),
            orientations=np.ones(count, int),
            focal_exif_px=np.full(count, np.nan),
            gps=np.full((count, 3), np.nan) if gps is None else gps,
            duplicate_of=[0 if row in copies else -1 for row in range(count)],
            camera_models=["PINHOLE"],
            camera_sizes=[[320, 240]],
            camera_params=np.full((1, PARAM_SLOTS), np.nan),
            camera_sources=["given"],
            refused_names=["bad.jpg"],
            refused_reasons=["bad.jpg is cut off."],
            warnings=[],
        )
        index.write(self.file("index"), Header("index_images", 1, "scene"))

    def file(self, name):
        return self.folder / f"{name}.h5"

    def job(self, stage, options, inputs, outputs, former=None, **settings):
        return StageJob(
            stage=stage,
            scene="scene",
            inputs=inputs,
            outputs=tuple(outputs),
            options=options,
            settings=settings,
            former=former,
            terminal=self.terminal,
        )

    def block_files(self, stage):
        return [self.file(f"{stage}/{block}") for block in range(self.blocks)]

    def tile_files(self, stage):
        return [self.file(f"{stage}/{a}-{b}") for a in range(self.blocks) for b in range(a, self.blocks)]

    def extract(self, options=None, former=None, **settings):
        for block, output in enumerate(self.block_files("features")):
            inputs = {"index": self.file("index")}
            extract_features.run(
                self.job(
                    "extract_features",
                    options or ExtractFeaturesOptions(max_keypoints=400),
                    inputs,
                    [output],
                    former and former.block_files("features")[block],
                    images=str(self.images),
                    block=block,
                    **settings,
                )
            )

    def describe(self):
        features = self.block_files("features")
        vocabulary = self.file("vocabulary")
        learn_vocabulary.run(
            self.job(
                "learn_vocabulary", LearnVocabularyOptions(words=8), {"features": features}, [vocabulary]
            )
        )
        for path, output in zip(features, self.block_files("descriptors"), strict=True):
            inputs = {"features": path, "vocabulary": vocabulary}
            describe_images.run(self.job("describe_images", DescribeImagesOptions(), inputs, [output]))

    def select(self, options, pairs_file=""):
        options = options.resolve(len(NAMES), pairs_file)
        descriptors = self.block_files("descriptors") if "retrieval" in options.method else []
        features = self.block_files("features") if options.looks_at_pairs else []
        inputs = {"index": self.file("index"), "descriptors": descriptors, "features": features}
        select_pairs.run(
            self.job(
                "select_pairs",
                options,
                inputs,
                self.tile_files("pairs"),
                blocks=self.blocks,
                pairs_file=pairs_file,
            )
        )
        rows = []
        for path in self.tile_files("pairs"):
            part = ImagePairs.read(path)
            columns = (part.reasons, part.similarities, part.likenesses)
            rows += list(zip(map(tuple, part.pairs), *columns, strict=True))
        return sorted(rows, key=lambda row: row[0])

    def match(self, options=None, former=None):
        for tile, output in enumerate(self.tile_files("matches")):
            blocks = sorted({int(part) for part in output.stem.split("-")})
            inputs = {
                "pairs": self.tile_files("pairs")[tile],
                "features": [self.block_files("features")[block] for block in blocks],
            }
            match_pairs.run(
                self.job(
                    "match_pairs",
                    options or MatchPairsOptions(),
                    inputs,
                    [output],
                    former and former.tile_files("matches")[tile],
                )
            )
        found = {}
        for path in self.tile_files("matches"):
            part = PairMatches.read(path)
            for row, pair in enumerate(part.pairs):
                rows = slice(part.offsets[row], part.offsets[row + 1])
                found[tuple(pair.tolist())] = (part.matches[rows], part.scores[rows], part.digests[row])
        return found

    def features(self):
        found = {}
        for path in self.block_files("features"):
            part = LocalFeatures.read(path)
            for row, name in enumerate(part.names):
                rows = slice(part.offsets[row], part.offsets[row + 1])
                found[name] = {
                    column: getattr(part, column)[rows]
                    for column in ("keypoints", "descriptors", "scores", "scales", "angles", "colors")
                }
        return found


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


def test_colors_are_those_of_the_image(whole, images):
    found = whole.features()["other.png"]
    picture = cv2.imread(str(images / "other.png"))
    columns, rows = np.floor(found["keypoints"]).astype(int).T
    np.testing.assert_array_equal(found["colors"], picture[rows, columns])


def test_vocabulary_and_pairs_do_not_depend_on_the_blocks(whole, dealt):
    np.testing.assert_array_equal(
        Vocabulary.read(whole.file("vocabulary")).centers, Vocabulary.read(dealt.file("vocabulary")).centers
    )
    options = SelectPairsOptions(method="sequential+retrieval", look_ahead=1, top_k=2)
    assert str(whole.select(options)) == str(dealt.select(options))


def test_a_picture_that_cannot_be_read_resembles_none(images, tmp_path):
    pytest.importorskip("torch")
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


def test_retrieval_prefers_what_overlaps(dealt):
    rows = dealt.select(SelectPairsOptions(method="retrieval", top_k=1, min_score=0.0))
    pairs = {pair for pair, *_ in rows}
    assert pairs & {(0, 1), (0, 5), (1, 5)}
    assert not any(2 in pair or 3 in pair for pair in pairs)
    assert all(0 < similarity <= 1.001 for _, _, similarity, _ in rows)
    vectors = GlobalDescriptors.read(dealt.block_files("descriptors")[0]).descriptors
    assert vectors.shape[1] == 8 * 128


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


def test_copies_of_an_image_are_left_out_but_where_a_list_names_them(images, tmp_path):
    scene = Scene(tmp_path / "copies", images, 2, copies=(1, 5))
    scene.extract()
    options = SelectPairsOptions(preview_keypoints=0, method="exhaustive")
    pairs = {pair for pair, *_ in scene.select(options)}
    assert pairs == {(i, j) for i in range(6) for j in range(i + 1, 6) if not {1, 5} & {i, j}}
    path = tmp_path / "pairs.txt"
    path.write_text(f"{NAMES[0]} {NAMES[1]}\n", "utf-8")
    assert [pair for pair, *_ in scene.select(SelectPairsOptions(method="listed"), str(path))] == [(0, 1)]


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
