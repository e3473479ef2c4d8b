"""Front-ends by name: their methods, what fits together, and what a plan makes of them."""

import json
import shlex
import typing
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from snakemake.cli import get_argument_parser

from snakesfm.config.configuration import FrontEndName, options_class
from snakesfm.digests import settings_text
from snakesfm.errors import ConfigError
from snakesfm.features.extraction import DETECTORS
from snakesfm.front_ends import (
    DETECTOR_FREE,
    FRONT_ENDS,
    LEARNED_DESCRIPTORS,
    TRAINED_ON,
    check_methods,
    fetch_command,
    needed_weights,
)
from snakesfm.learned.weights import WEIGHT_FILES
from snakesfm.matching.detector_free import DETECTOR_FREE_MATCHERS
from snakesfm.matching.matcher import MATCHERS
from snakesfm.pipeline import STAGES
from snakesfm.plan import Plan
from snakesfm.retrieval.descriptor import DESCRIPTORS
from snakesfm.rule_inputs import (
    block_tiles,
    coordinate_files,
    described_features,
    described_images,
    exported_keypoints,
    keypoint_files,
    match_files,
    matched_features,
    matched_images,
    tile_features,
    tile_matches,
)
from snakesfm.scene_plan import STAGES_IN_DETECTOR_PIXELS, ScenePlan


def plan_of(tmp_path: Path, **config: object) -> Plan:
    images = tmp_path / "scene" / "images"
    if not images.is_dir():
        images.mkdir(parents=True)
        for number in range(3):
            (images / f"{number}.jpg").write_bytes(b"image %d" % number)
    return Plan({"images": str(images), "output": str(tmp_path / "out"), **config})


def empty_model(folder: Path) -> str:
    """Files of a COLMAP model that nothing reads."""
    for part in ("cameras", "images", "points3D"):
        (folder / f"{part}.txt").write_bytes(b"")
    return str(folder)


def imported_by(config: dict[str, Any], folder: Path) -> dict[str, str]:
    """The key that the front-end 'imported' needs, and others refuse."""
    return {"imported": str(folder)} if config.get("front_end") == "imported" else {}


def allowed(stage: str) -> set[str]:
    return set(typing.get_args(options_class(stage).model_fields["method"].annotation))


def test_names_methods_and_registries_agree() -> None:
    assert set(typing.get_args(FrontEndName)) == {"", *FRONT_ENDS}
    assert {end.detector for end in FRONT_ENDS.values()} == allowed("extract_features")
    assert {end.matcher for end in FRONT_ENDS.values()} == allowed("match_pairs")
    assert set(DETECTORS) == allowed("extract_features") - {"virtual", "imported"}
    assert set(MATCHERS) == allowed("match_pairs") - {"imported", *DETECTOR_FREE}
    assert set(DETECTOR_FREE_MATCHERS) == set(DETECTOR_FREE)
    assert set(DESCRIPTORS) == set(LEARNED_DESCRIPTORS) == allowed("describe_images") - {"vlad"}
    assert set(LEARNED_DESCRIPTORS) <= set(WEIGHT_FILES)


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_every_front_end_fits_together_and_its_weights_are_known(name: str) -> None:
    end = FRONT_ENDS[name]
    check_methods(end.detector, end.matcher)
    for stage, method in (("extract_features", end.detector), ("match_pairs", end.matcher)):
        assert options_class(stage)(method=method).method == method
        assert set(needed_weights(stage, method, end.detector)) <= set(WEIGHT_FILES)


def test_the_default_needs_no_network(tmp_path: Path) -> None:
    plan = plan_of(tmp_path)
    assert plan.models == []
    (scene,) = plan.scenes.values()
    assert scene.method("extract_features") == "sift" and scene.gpus("extract_features") == 0
    assert "weights" not in scene.params("extract_features", {"block": "0"}, True)


@pytest.mark.parametrize("matcher", TRAINED_ON)
def test_a_matcher_refuses_keypoints_that_it_does_not_know(matcher: str) -> None:
    with pytest.raises(ConfigError, match=f"match_pairs.method '{matcher}'.*front_end="):
        check_methods("sift", matcher)
    check_methods("aliked", "mutual_ratio")


def test_a_front_end_sets_the_methods_and_names_its_weights(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, front_end="aliked+lightglue", weights=str(tmp_path / "w"))
    (scene,) = plan.scenes.values()
    assert plan.models == ["aliked", "aliked_lightglue"]
    extract = json.loads(scene.params("extract_features", {"block": "0"}, True))
    assert extract["options"]["method"] == "aliked"
    assert extract["settings"]["models"] == ["aliked"] and scene.gpus("extract_features") == 1
    match = json.loads(scene.params("match_pairs", {"tile": "0-0"}, True))
    assert match["options"]["method"] == "lightglue" and match["settings"]["detector"] == "aliked"
    command = match["settings"]["fetch"]
    assert command.endswith(f"fetch_weights --config front_end=aliked+lightglue weights={tmp_path / 'w'}")


def test_the_command_that_fetches_weights_is_one_that_snakemake_takes() -> None:
    command = fetch_command("loftr", {"describe_images": "megaloc", "match_pairs": "loftr"}, "my weights")
    program, *arguments = shlex.split(command)
    parsed = get_argument_parser().parse_args(arguments)
    # without a number of cores it starts no job
    assert (program, parsed.targets, parsed.cores) == ("snakemake", ["fetch_weights"], 1)
    assert parsed.config == ["front_end=loftr", "describe_images={method: megaloc}", "weights=my weights"]


def test_other_weights_change_the_params(tmp_path: Path) -> None:
    def params() -> str:
        plan = plan_of(tmp_path, front_end="xfeat+lighterglue", weights=str(tmp_path))
        (scene,) = plan.scenes.values()
        return scene.params("extract_features", {"block": "0"}, True)

    before = params()
    (tmp_path / "xfeat.pt").write_bytes(b"some")
    assert before != params()


def test_the_size_of_batches_changes_what_a_job_asks_for_but_no_params(tmp_path: Path) -> None:
    scenes = []
    for config in ({}, {"batch_size": 4}, {"batch_size": 4, "device": "cuda"}):
        plan = plan_of(tmp_path, front_end="superpoint+superglue", **config)
        scenes += plan.scenes.values()
    stages = {"extract_features": {"block": "0"}, "match_pairs": {"tile": "0-0"}}
    for stage, wildcards in stages.items():
        assert scenes[0].params(stage, wildcards, True) == scenes[1].params(stage, wildcards, True)
        assert [scene.load(stage).batch for scene in scenes] == [1, 4, 1]
    for wrong in (0, 257, "many"):
        with pytest.raises(ConfigError, match="batch_size"):
            plan_of(tmp_path, batch_size=wrong)


def test_exact_keypoints_are_not_refined_in_the_images(tmp_path: Path) -> None:
    for front_end, refined in (("virtual", False), ("sift", "auto")):
        plan = plan_of(tmp_path, front_end=front_end, reference=empty_model(tmp_path))
        (scene,) = plan.scenes.values()
        options = json.loads(scene.params("adjust_bundle", {}, True))["options"]
        assert options["refine_keypoints"] == refined


def test_virtual_and_imported_ask_for_what_they_read(tmp_path: Path) -> None:
    for front_end in ("virtual", "virtual_places"):
        with pytest.raises(ConfigError, match="reference=PATH"):
            plan_of(tmp_path, front_end=front_end)
    with pytest.raises(ConfigError, match="imported=DIR"):
        plan_of(tmp_path, front_end="imported")
    (tmp_path / "features.h5").write_bytes(b"features")
    with pytest.raises(ConfigError, match=r"features\.h5', given as imported= .* is not a folder"):
        plan_of(tmp_path, front_end="imported", imported=str(tmp_path / "features.h5"))
    folder = tmp_path / "hloc"
    folder.mkdir()
    (folder / "pairs.txt").write_text("0.jpg 1.jpg\n")
    (scene,) = plan_of(tmp_path, front_end="imported", imported=str(folder)).scenes.values()
    assert scene.select_pairs.method == "listed" and scene.pairs_file == str(folder / "pairs.txt")
    before = scene.params("match_pairs", {"tile": "0-0"}, True)
    (folder / "matches.h5").write_bytes(b"matches")
    assert before != scene.params("match_pairs", {"tile": "0-0"}, True)


def test_imported_matches_without_a_list_are_the_list(tmp_path: Path) -> None:
    folder = tmp_path / "hloc"
    folder.mkdir()
    config: dict[str, Any] = {
        "front_end": "imported",
        "imported": str(folder),
        "select_pairs": {"exhaustive_up_to": 2},
    }

    def plan() -> ScenePlan:
        (scene,) = plan_of(tmp_path, **config).scenes.values()
        return scene

    assert plan().select_pairs.method == "sequential+retrieval"
    matches = folder / "matches.h5"
    matches.write_bytes(b"no HDF5 file")
    # the job says so, in one sentence
    assert plan().pair_count == 0
    with h5py.File(matches, "w") as file:
        for pair in ("0.jpg/2.jpg", "1.jpg/2.jpg"):
            file[f"{pair}/matches0"] = np.zeros(1, int)
    scene = plan()
    assert scene.select_pairs.method == "listed" and scene.pairs_file == str(matches)
    assert scene.proposed_pair_count == scene.pair_count == 2
    before = scene.params("select_pairs", {}, True)
    with h5py.File(matches, "a") as file:
        file["0.jpg/1.jpg/matches0"] = np.zeros(1, int)
    assert before != plan().params("select_pairs", {}, True)
    (folder / "pairs.txt").write_text("0.jpg 1.jpg\n")
    assert plan().pairs_file == str(folder / "pairs.txt") and plan().pair_count == 1
    config["pairs"] = str(tmp_path / "own.txt")
    (tmp_path / "own.txt").write_text("0.jpg 2.jpg\n")
    assert plan().pairs_file == config["pairs"]
    config |= {"pairs": "", "select_pairs": {"method": "exhaustive"}}
    assert plan().select_pairs.method == "exhaustive"


def test_without_keypoints_the_stages_after_matching_read_merged_ones(tmp_path: Path) -> None:
    given = {"front_end": "loftr", "weights": str(tmp_path / "w")}
    (scene,) = plan_of(tmp_path, **given).scenes.values()
    assert scene.gpus("match_pairs") == 1 and scene.gpus("extract_features") == 0
    plan = plan_of(tmp_path, **given, device="cpu")
    (scene,) = plan.scenes.values()
    assert plan.models == ["loftr"] and scene.gpus("match_pairs") == 0
    assert scene.features_stage == "merge_keypoints" and scene.matches_stage == "index_matches"
    assert not any("extract_features" in file for file in scene.all_files())
    assert [Path(file).stem for file in block_tiles(scene, "0")] == ["0-0", "0-1"]
    assert matched_features(scene, "0-1") == [] != tile_features(scene, "0-1")
    assert [Path(file).name for file in matched_images(scene)] == ["index.h5"]
    assert coordinate_files(scene) == scene.files("match_pairs", "tiles") != match_files(scene)
    match = json.loads(scene.params("match_pairs", {"tile": "0-0"}, True))
    assert match["options"]["min_score"] == 0.2 and match["settings"]["device"] == "cpu"
    (sift,) = plan_of(tmp_path).scenes.values()
    assert sift.features_stage == "extract_features" and sift.matches_stage == "match_pairs"
    assert not any("merge_keypoints" in file for file in sift.all_files())
    assert matched_features(sift, "0-1") == tile_features(sift, "0-1") == keypoint_files(sift)
    (network,) = plan_of(tmp_path, front_end="xfeat+lighterglue", weights="w").scenes.values()
    assert matched_images(network) == matched_images(scene) and coordinate_files(network) == []
    assert matched_images(sift) == coordinate_files(sift) == exported_keypoints(sift) == []
    (complete,) = plan_of(tmp_path, export_model={"all_keypoints": True}).scenes.values()
    assert exported_keypoints(complete) == keypoint_files(sift)
    assert tile_matches(sift, "0-1") in match_files(sift) == sift.files("match_pairs", "tiles")


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({}, {"detector_shorter_side_px": 760}),
        ({"extract_features": {"max_shorter_side_px": 1520}}, {"detector_shorter_side_px": 1520}),
        ({"front_end": "xfeat+lighterglue"}, {"detector_shorter_side_px": 760}),
        ({"front_end": "imported"}, {"detector_shorter_side_px": 760}),
        ({"front_end": "loftr"}, {"detector_longer_side_px": 840}),
        ({"front_end": "virtual"}, {}),
        ({"front_end": "virtual_places"}, {}),
    ],
)
def test_stages_after_matching_are_told_how_large_the_detector_saw_the_images(
    config: dict[str, Any], expected: dict[str, int], tmp_path: Path
) -> None:
    here = str(tmp_path)
    config = {**config, **imported_by(config, tmp_path)}
    plan = plan_of(tmp_path, weights=here, reference=empty_model(tmp_path), **config)
    (scene,) = plan.scenes.values()
    for stage in ("merge_keypoints", *STAGES_IN_DETECTOR_PIXELS, "adjust_bundle"):
        told = json.loads(scene.params(stage, {"block": "0", "tile": "0-0"}, True))["settings"]
        assert {name: value for name, value in told.items() if name.startswith("detector_")} == expected


def test_masks_reach_extraction_and_export_and_their_content_counts(tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    (masks / "1.jpg.png").write_bytes(b"mask")
    (before,) = plan_of(tmp_path).scenes.values()
    (scene,) = plan_of(tmp_path, masks=str(masks)).scenes.values()
    wildcards = {"block": "0", "tile": "0-0"}
    for stage in STAGES:
        same = scene.params(stage, wildcards, True) == before.params(stage, wildcards, True)
        assert same == (stage not in ("extract_features", "export_model"))
    (masks / "1.jpg.png").write_bytes(b"another mask")
    (changed,) = plan_of(tmp_path, masks=str(masks)).scenes.values()
    told = [plan.settings("extract_features", wildcards, True) for plan in (scene, changed)]
    assert told[0]["masks"] == told[1]["masks"] and told[0]["masks_content"] != told[1]["masks_content"]
    # a job on a cluster is not told the content, which it finds and tells of in its artifact
    job = scene.settings("extract_features", wildcards, False)
    assert job["masks_content"] == ""
    made = settings_text({**job, "masks_content": told[0]["masks_content"]}, 0)
    expected = [plan.settings_text("extract_features", Path("0.h5")) for plan in (scene, changed, before)]
    assert [made == text for text in expected] == [True, False, False]


@pytest.mark.parametrize(
    ("masks", "config", "reason"),
    [
        ("none", {}, "does not exist"),
        ("scene/images", {}, "is inside the image folder"),
        ("empty", {}, r"contains no mask for any image of scene 'scene'.*a/b\.jpg\.png"),
        ("file", {}, "is not a folder"),
        ("masks", {"front_end": "loftr"}, "use another front_end"),
        ("masks", {"front_end": "imported"}, "use another front_end"),
    ],
)
def test_masks_that_would_do_nothing_are_refused(
    masks: str, config: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    for folder in ("masks", "empty"):
        (tmp_path / folder).mkdir()
    (tmp_path / "masks" / "1.png").write_bytes(b"mask")
    (tmp_path / "file").write_bytes(b"mask")
    config = {**config, **imported_by(config, tmp_path)}
    with pytest.raises(ConfigError, match=reason):
        plan_of(tmp_path, masks=str(tmp_path / masks), weights=str(tmp_path), **config)


def test_networks_that_describe_images_need_no_keypoints_and_no_vocabulary(tmp_path: Path) -> None:
    config = {"front_end": "loftr", "select_pairs": {"method": "retrieval"}}
    for method, models in (("vlad", ["loftr"]), ("megaloc", ["loftr", "megaloc"])):
        plan = plan_of(tmp_path, **config, describe_images={"method": method})
        (scene,) = plan.scenes.values()
        assert plan.models == models
        assert scene.describes_pictures == (method == "megaloc") == (not scene.vocabulary())
        assert (
            len(described_images(scene)) == (method == "megaloc") == 1 - len(described_features(scene, "0"))
        )
        assert scene.gpus("describe_images") == (method == "megaloc")
        assert scene.detects_keypoints == (method == "vlad")
        # what a run makes again where it was lost
        made = {Path(file).parent.name for file in scene.all_files()}
        assert {"describe_images", "match_pairs", "index_matches"} <= made
        assert ("learn_vocabulary" in made) == (method == "vlad")
    command = json.loads(scene.params("describe_images", {"block": "0"}, True))["settings"]["fetch"]
    assert "front_end=loftr" in command and "'describe_images={method: megaloc}'" in command


@pytest.mark.parametrize(("pairs", "models"), [("retrieval", ["aliked"]), ("exhaustive", [])])
def test_keypoints_that_only_choose_pairs_have_their_network_too(
    tmp_path: Path, pairs: str, models: list[str]
) -> None:
    methods = {"extract_features": {"method": "aliked"}, "match_pairs": {"method": "loftr"}}
    (scene,) = plan_of(tmp_path, **methods, select_pairs={"method": pairs}).scenes.values()
    assert scene.models("extract_features") == models
    assert scene.gpus("extract_features") == len(models)


def test_large_images_and_many_keypoints_ask_for_what_they_take(tmp_path: Path) -> None:
    (scene,) = plan_of(tmp_path, extract_features={"max_shorter_side_px": 1520}).scenes.values()
    assert scene.load("extract_features").area == 4.0
    assert scene.load("match_pairs").keypoints == 1.0
    (scene,) = plan_of(tmp_path, extract_features={"max_keypoints": 12_000}).scenes.values()
    assert scene.load("match_pairs").keypoints == 2.4


def test_one_file_of_weights_serves_one_network(tmp_path: Path) -> None:
    file = tmp_path / "mine.ckpt"
    file.write_bytes(b"some")
    (scene,) = plan_of(tmp_path, front_end="loftr", weights=str(file)).scenes.values()
    first = scene.params("match_pairs", {"tile": "0-0"}, True)
    file.write_bytes(b"other")
    (scene,) = plan_of(tmp_path, front_end="loftr", weights=str(file)).scenes.values()
    assert first != scene.params("match_pairs", {"tile": "0-0"}, True)
    with pytest.raises(ConfigError, match=r"needs the weights of 2 networks .*give a folder"):
        plan_of(tmp_path, front_end="xfeat+lighterglue", weights=str(file))


def test_weights_are_fetched_without_images(tmp_path: Path) -> None:
    config = {"images": str(tmp_path / "none"), "output": str(tmp_path / "out"), "front_end": "loftr"}
    plan = Plan(config, weights_only=True)
    assert plan.models == ["loftr"] and not plan.scenes
    with pytest.raises(ConfigError, match="does not exist"):
        Plan(config)
