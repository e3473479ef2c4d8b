"""Front-ends by name: their methods, what fits together, and what a plan makes of them."""

import json
import typing
from pathlib import Path

import pytest

from snakesfm.config.configuration import FrontEndName, options_class
from snakesfm.errors import ConfigError
from snakesfm.features.extraction import DETECTORS
from snakesfm.front_ends import FRONT_ENDS, TRAINED_ON, check_methods, needed_weights
from snakesfm.learned.weights import WEIGHT_FILES
from snakesfm.matching.matcher import MATCHERS
from snakesfm.plan import Plan


def plan_of(tmp_path: Path, **config: object) -> Plan:
    images = tmp_path / "scene" / "images"
    if not images.is_dir():
        images.mkdir(parents=True)
        for number in range(3):
            (images / f"{number}.jpg").write_bytes(b"image %d" % number)
    return Plan({"images": str(images), "output": str(tmp_path / "out"), **config})


def allowed(stage: str) -> set[str]:
    return set(typing.get_args(options_class(stage).model_fields["method"].annotation))


def test_names_methods_and_registries_agree() -> None:
    assert set(typing.get_args(FrontEndName)) == {"", *FRONT_ENDS}
    assert {end.detector for end in FRONT_ENDS.values()} == allowed("extract_features")
    assert {end.matcher for end in FRONT_ENDS.values()} == allowed("match_pairs")
    assert set(DETECTORS) == allowed("extract_features") - {"virtual", "imported"}
    assert set(MATCHERS) == allowed("match_pairs") - {"imported"}


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_every_front_end_fits_together_and_its_weights_are_known(name: str) -> None:
    end = FRONT_ENDS[name]
    check_methods(end.detector, end.matcher)
    for stage, method in (("extract_features", end.detector), ("match_pairs", end.matcher)):
        options = options_class(stage)(method=method)
        assert set(needed_weights(stage, options, end.detector)) <= set(WEIGHT_FILES)


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
    assert command.startswith("snakemake fetch_weights --config front_end=aliked+lightglue")
    assert f"weights={tmp_path / 'w'}" in command


def test_other_weights_change_the_params(tmp_path: Path) -> None:
    def params() -> str:
        plan = plan_of(tmp_path, front_end="xfeat+lighterglue", weights=str(tmp_path))
        (scene,) = plan.scenes.values()
        return scene.params("extract_features", {"block": "0"}, True)

    before = params()
    (tmp_path / "xfeat.pt").write_bytes(b"some")
    assert before != params()


def test_exact_keypoints_are_not_refined_in_the_images(tmp_path: Path) -> None:
    for front_end, refined in (("virtual", False), ("sift", "auto")):
        plan = plan_of(tmp_path, front_end=front_end, reference=str(tmp_path))
        (scene,) = plan.scenes.values()
        options = json.loads(scene.params("adjust_bundle", {}, True))["options"]
        assert options["refine_keypoints"] == refined


def test_virtual_and_imported_ask_for_what_they_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="reference=PATH"):
        plan_of(tmp_path, front_end="virtual")
    with pytest.raises(ConfigError, match="imported=DIR"):
        plan_of(tmp_path, front_end="imported")
    folder = tmp_path / "hloc"
    folder.mkdir()
    (folder / "pairs.txt").write_text("0.jpg 1.jpg\n")
    (scene,) = plan_of(tmp_path, front_end="imported", imported=str(folder)).scenes.values()
    assert scene.select_pairs.method == "listed" and scene.pairs_file == str(folder / "pairs.txt")
    before = scene.params("match_pairs", {"tile": "0-0"}, True)
    (folder / "matches.h5").write_bytes(b"matches")
    assert before != scene.params("match_pairs", {"tile": "0-0"}, True)
