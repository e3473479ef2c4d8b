"""The plan: blocks, tiles, files and rules, computed before anything runs."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from planned_images import make_images, plan_of

from snakesfm.blocks import choose_blocks, deal_blocks, tile_names
from snakesfm.errors import ConfigError
from snakesfm.plan import Plan
from snakesfm.records import split_words
from snakesfm.rule_inputs import global_descriptors, previewed_features
from snakesfm.rule_settings import check_named_together
from snakesfm.seeding import derive_seed


@pytest.mark.parametrize("undistort", [False, True])
def test_only_undistorting_asks_for_its_threads(tmp_path: Path, undistort: bool) -> None:
    images = str(make_images(tmp_path / "scene", 3))
    scene = plan_of(tmp_path, images=images, export_model={"undistort": undistort}).scenes["scene"]
    assert scene.load("export_model", 3).undistorting == (3 if undistort else 0)
    assert scene.load("adjust_bundle", 3).undistorting == 0


@pytest.mark.parametrize("key", ["images", "output", "reference", "weights", "SNAKESFM_CACHE"])
def test_a_home_folder_that_is_not_known_gives_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    config = {"images": str(make_images(tmp_path / "scene", 3))}
    if key == "SNAKESFM_CACHE":
        monkeypatch.setenv(key, "~nobody-of-this-name/x")
    else:
        config[key] = "~nobody-of-this-name/x"
    with pytest.raises(ConfigError, match=f"'~nobody-of-this-name' of {key}=.* write the whole path"):
        plan_of(tmp_path, **config)
    scenes = {"one": {"images": str(tmp_path / "scene"), "cameras": "~nobody-of-this-name/K.txt"}}
    monkeypatch.delenv("SNAKESFM_CACHE", raising=False)
    with pytest.raises(ConfigError, match=r"of cameras=~nobody-of-this-name/K\.txt is not known"):
        plan_of(tmp_path, scenes=scenes)


@given(st.integers(1, 40))
def test_tiles_cover_every_pair_of_blocks_once(blocks: int) -> None:
    tiles = [tuple(map(int, name.split("-"))) for name in tile_names(blocks)]
    assert len(tiles) == len(set(tiles)) == blocks * (blocks + 1) // 2
    assert all(0 <= a <= b < blocks for a, b in tiles)


@given(st.integers(1, 200_000), st.integers(1, 200_000))
def test_more_images_never_get_fewer_blocks(first: int, second: int) -> None:
    low, high = sorted((first, second))
    assert 2 <= choose_blocks(low) <= choose_blocks(high) <= 48
    assert [choose_blocks(count) for count in (60, 61, 1000, 1001)] == [2, 4, 4, 8]


@given(st.sets(st.text(min_size=1), max_size=60), st.integers(1, 64))
def test_no_block_is_larger_than_it_must_be(names: set[str], blocks: int) -> None:
    dealt = deal_blocks(sorted(names), blocks)
    assert len(dealt) == len(names)
    assert set(dealt) <= set(range(blocks))
    assert max((dealt.count(block) for block in dealt), default=0) <= -(-len(names) // blocks)


def test_the_order_of_images_does_not_matter() -> None:
    names = [f"DSC_{number:05d}.JPG" for number in range(100)]
    forwards = dict(zip(names, deal_blocks(names, 7), strict=True))
    assert forwards == dict(zip(names[::-1], deal_blocks(names[::-1], 7), strict=True))


@pytest.mark.parametrize("added", [1, 10])
@pytest.mark.parametrize(("count", "blocks"), [(50, 2), (200, 4), (2000, 8)])
def test_more_images_move_few_others(count: int, blocks: int, added: int) -> None:
    names = [f"DSC_{number:05d}.JPG" for number in range(count)]
    before = deal_blocks(names, blocks)
    after = deal_blocks([*names, *(f"new/{number}.JPG" for number in range(added))], blocks)
    moved = sum(one != other for one, other in zip(before, after, strict=False))
    assert moved <= blocks * added
    assert len(set(before)) == len(set(after)) == blocks


def test_seeds_differ_by_what_they_are_for_and_fit_31_bits() -> None:
    seeds = {derive_seed(0, "match_pairs", f"{k}.jpg") for k in range(1000)}
    assert len(seeds) == 1000
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert derive_seed(0, "a", "b") != derive_seed(0, "ab") != derive_seed(1, "ab")


def test_small_scenes_are_exhaustive_and_large_ones_retrieve(tmp_path: Path) -> None:
    make_images(tmp_path / "small", 5)
    make_images(tmp_path / "large", 1001)
    small = plan_of(tmp_path, images=str(tmp_path / "small")).scenes["small"]
    large = plan_of(tmp_path, images=str(tmp_path / "large")).scenes["large"]
    assert small.select_pairs.method == "exhaustive"
    assert global_descriptors(small) == []
    assert not [file for file in small.all_files() if "describe_images" in file]
    assert large.select_pairs.method == "sequential+retrieval"
    assert len(global_descriptors(large)) == large.blocks == 8
    for scene in (small, large):
        assert previewed_features(scene) == scene.files("extract_features", "blocks")
    assert (large.pair_count, large.proposed_pair_count) == (30 * 1001, 110 * 1001)
    assert [large.load(stage).pairs for stage in ("calibrate_cameras", "select_pairs")] == [
        30 * 1001,
        110 * 1001,
    ]
    assert small.pair_count == small.proposed_pair_count == 10
    learned = plan_of(tmp_path, images=str(tmp_path / "small"), front_end="aliked+lightglue")
    assert previewed_features(learned.scenes["small"]) == []


@pytest.mark.parametrize(
    ("front_end", "method", "stages"),
    [
        ("sift", "retrieval", {"extract_features"}),
        ("loftr", "retrieval", {"extract_features", "merge_keypoints"}),
        ("loftr", "exhaustive", {"merge_keypoints"}),
    ],
)
def test_keypoints_are_artifacts_wherever_they_are_made(
    tmp_path: Path, front_end: str, method: str, stages: set[str]
) -> None:
    images = str(make_images(tmp_path / "scene", 5))
    plan = plan_of(tmp_path, images=images, front_end=front_end, select_pairs={"method": method})
    scene = plan.scenes["scene"]
    files = scene.artifacts()
    assert len(files) == len(set(files))
    made = {Path(file).parent.name for file in files}
    assert made & {"extract_features", "merge_keypoints"} == stages
    assert all(set(scene.files(stage, "blocks")) <= set(files) for stage in stages)


def test_scenes_of_other_sizes_have_rules_of_their_own(tmp_path: Path) -> None:
    make_images(tmp_path / "a", 3)
    make_images(tmp_path / "b", 70)
    scenes = {name: {"images": str(tmp_path / name)} for name in "ab"}
    plan = plan_of(tmp_path, scenes=scenes)
    assert plan.scenes_by_blocks() == {2: ["a"], 4: ["b"]}
    assert [plan.select_pairs_rule(blocks) for blocks in (2, 4)] == [
        "select_pairs_2_blocks",
        "select_pairs",
    ]
    assert plan.select_pairs_twins() == {"select_pairs_2_blocks"}
    more = plan_of(tmp_path, scenes=scenes | {"c": scenes["a"]})
    assert [more.select_pairs_rule(blocks) for blocks in (2, 4)] == [
        "select_pairs",
        "select_pairs_4_blocks",
    ]
    one = plan_of(tmp_path, scenes={"a": scenes["a"]})
    assert one.select_pairs_rule(2) == "select_pairs" and one.select_pairs_twins() == set()


@pytest.mark.parametrize(
    ("words", "is_refused"),
    [
        ("--until select_pairs", True),
        ("--until=select_pairs", True),
        ("-R match_pairs select_pairs", True),
        ("-kUselect_pairs", True),
        ("-nRselect_pairs", True),
        ("--until select_pairs select_pairs_2_blocks", False),
        ("--until match_pairs --set-resources select_pairs:mem_mb=10 --set-threads select_pairs=1", False),
        ("--until select_pairs_2_blocks", False),
    ],
)
def test_a_rule_is_named_with_its_twins_or_not_at_all(words: str, is_refused: bool) -> None:
    said = split_words(words.split())
    if is_refused:
        with pytest.raises(ConfigError, match="say 'select_pairs select_pairs_2_blocks'"):
            check_named_together(said, "select_pairs", {"select_pairs_2_blocks"})
    else:
        check_named_together(said, "select_pairs", {"select_pairs_2_blocks"})
    check_named_together(said, "select_pairs", set())


@pytest.mark.parametrize("output", ["{braces}", "a{b", "a<log>"])
def test_an_output_folder_with_braces_is_refused(tmp_path: Path, output: str) -> None:
    make_images(tmp_path / "scene", 2)
    with pytest.raises(ConfigError, match="braces"):
        Plan({"images": str(tmp_path / "scene"), "output": str(tmp_path / output)})
