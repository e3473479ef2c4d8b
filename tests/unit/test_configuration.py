"""The configuration: unknown keys, wrong values, scenes."""

import datetime
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesfm.config.configuration import (
    STAGES,
    RunOptions,
    check_spelling,
    list_scenes,
    load_configuration,
    options_class,
    scene_name,
)
from snakesfm.errors import ConfigError


@pytest.mark.parametrize(
    ("values", "parts"),
    [
        ({"imges": "x"}, ["imges", "images"]),
        ({"extract_features": {"max_keypoint": 3}}, ["extract_features.max_keypoint", "max_keypoints"]),
        ({"match_pair": {}}, ["match_pair", "match_pairs"]),
        ({"scenes": {"a": {"images": "x", "camera": "y"}}}, ["scenes.a.camera", "cameras"]),
        ({"extract_features": {"max_keypoints": "many"}}, ["max_keypoints' = 'many'", "or 'auto'"]),
        ({"match_pairs": {"preview_keypoints": 0}}, ["mean 'select_pairs.preview_keypoints'?"]),
        ({"max_keypoints": 3000}, ["key 'max_keypoints'", "mean 'extract_features.max_keypoints'?"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"blocks": 0}, ["'blocks' = 0", "greater than or equal to 1 (or 'auto')."]),
        ({"intrinsics": "free"}, ["intrinsics", "fixed", "refine"]),
        ({"zzzzqqqq": 1}, ["zzzzqqqq", "known keys"]),
        (
            {"extract_features": {"surface_points": 5, "view_points": 5}},
            ["key 'extract_features': surface_points and view_points", "set one of them to 0."],
        ),
        (
            {"calibrate_cameras": {"min_focal_ratio": 7}},
            ["key 'calibrate_cameras': min_focal_ratio 7 must be below max_focal_ratio 6"],
        ),
        ({"calibrate_cameras": {"max_focal_ratio": 0.4}}, ["min_focal_ratio 0.4 must be below"]),
        ({"select_pairs": {"top_k": -1}}, ["select_pairs.top_k' = -1", "to 1 (or 'auto')."]),
        ({"select_pairs": {"top_k": 0}}, ["select_pairs.top_k' = 0", "to 1 (or 'auto')."]),
        ({"select_pairs": {"top_k": 100_001}}, ["select_pairs.top_k", "or equal to 100000"]),
        ({"extract_features": {"edge_threshold": 1.0}}, ["edge_threshold' = 1.0", "greater than 1."]),
        (
            {"adjust_bundle": {"refine_finenesses": [2.0, 1.0]}},
            ["key 'adjust_bundle': refine_finenesses must increase"],
        ),
        ({"adjust_bundle": {"thresholds_px": [5, 0]}}, ["thresholds_px' = 0: ", "greater than 0."]),
        ({"adjust_bundle": {"early_loss_share": 0}}, ["early_loss_share' = 0: ", "equal to 0.001."]),
        ({"evaluate_model": {"relative_thresholds_deg": [0, 1]}}, ["_deg' = 0: ", "greater than 0."]),
        ({"evaluate_model": {"global_thresholds_deg": [1, 181]}}, ["_deg' = 181: ", "equal to 180."]),
        ({"adjust_bundle": {"max_iterations": 2**31}}, ["max_iterations' = 2147483648: ", "1000000"]),
        ({"average_translations": {"ray_sigma_deg": float("inf")}}, ["ray_sigma_deg' = inf: ", "to 10."]),
        ({"average_rotations": {"min_component_images": 2}}, ["_images' = 2: ", "equal to 3."]),
        ({"export_model": {"georeference": "maybe"}}, ["= 'maybe': ", "be true or false (or 'auto')."]),
        ({"adjust_bundle": {"complete_tracks": "often"}}, ["= 'often': ", "be true or false."]),
        ({"adjust_bundle": {"loss_scale_px": "many"}}, ["= 'many': ", "be a number (or 'auto')."]),
        (
            {"extract_features": None, "max_keypoints": 3},
            ["key 'extract_features' has no value", "indented below it, such as 'max_keypoints'"],
        ),
        (
            {"extract_features": {"max_keypoints:500": None}},
            [
                "'extract_features.max_keypoints:500' contains a colon: write 'max_keypoints: 500', with a space"
            ],
        ),
        ({"extract_features": "upright:true"}, ["key 'extract_features' = 'upright:true': ", "each colon"]),
        ({"blocks": 201}, ["'blocks' = 201: ", "less than or equal to 200 (or 'auto')."]),
        ({"calibrate_cameras": {"min_focal_ratio": 1e-300}}, ["min_focal_ratio' = 1e-300: ", "0.01."]),
        ({"calibrate_cameras": {"default_sigma": 1e-300}}, ["default_sigma' = 1e-300: ", "0.0001."]),
        ({"adjust_bundle": {"loss_scale_px": 1e-300}}, ["loss_scale_px' = 1e-300: ", "0.001 (or 'auto')."]),
        ({"extract_features": "sift"}, ["key 'extract_features' = 'sift': ", "a block of options"]),
        ({"scenes": {"a": {"image": "x"}}}, ["key 'scenes.a.image': did you mean 'images'?"]),
        ({"scenes": {"a": {"cameras": "x"}}}, ["key 'scenes.a.images' is missing"]),
        ({"scenes": {"a": "x"}}, ["key 'scenes.a' = 'x': ", "a block of options"]),
        ({"scenes": "x"}, ["key 'scenes' = 'x': ", "one block of keys per scene"]),
        ({"adjust_bundle": {"thresholds_px": 3}}, ["_px' = 3: ", "a list such as [10.0, 5.0, 3.0]."]),
        (
            {"adjust_bundle": {"thresholds_px": [3, 5]}},
            ["key 'adjust_bundle': thresholds_px must not rise"],
        ),
        ({"adjust_bundle": {"thresholds_px": [5, True]}}, ["= [5, true]: ", "not true or false."]),
        ({"images": None}, ["key 'images' has no value: set one"]),
        ({"select_pairs": {"top_k": None}}, ["key 'select_pairs.top_k' has no value: set one"]),
        ({"select_pairs": {"top_k": True}}, ["top_k' = true: ", "a number, not true or false."]),
        ({"adjust_bundle": {"loss_scale_px": False}}, ["_px' = false: ", "a number, not true or false."]),
        ({"select_pairs": {"top_k": 2.5}}, ["top_k' = 2.5: ", "a whole number (or 'auto')."]),
        ({"images": ["x"]}, ["'images' = ['x']: ", "should be text."]),
        ({"blocks": True}, ["'blocks' = true: ", "a number, not true or false."]),
        ({"seed": True}, ["'seed' = true: ", "a number, not true or false."]),
    ],
)
def test_a_wrong_key_or_value_gives_one_sentence_that_names_it(values: dict, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_configuration(values)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_values_at_the_edge_of_their_range_are_taken() -> None:
    load_configuration(
        {
            "calibrate_cameras": {"min_focal_ratio": 5.9},
            "select_pairs": {"top_k": 1},
            "extract_features": {"edge_threshold": 1.01},
        }
    )
    load_configuration({"select_pairs": {"top_k": 100_000}})
    load_configuration({"adjust_bundle": {"thresholds_px": [5, 5, 3], "refine_keypoints": True}})


def test_scene_takes_the_name_of_its_folder_or_of_its_parent() -> None:
    assert scene_name("/data/castle") == "castle"
    assert scene_name("/data/castle/images") == "castle"
    assert scene_name("/data/castle/Images/") == "castle"


def test_a_scene_has_the_name_of_the_link_that_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "DCIM" / "100_42" / "sub").mkdir(parents=True)
    (tmp_path / "castle").symlink_to(tmp_path / "DCIM" / "100_42")
    assert scene_name(str(tmp_path / "castle")) == "castle"
    assert scene_name(f"{tmp_path}/castle/./sub/../") == "castle"
    (tmp_path / "church").mkdir()
    (tmp_path / "church" / "images").symlink_to(tmp_path / "DCIM" / "100_42")
    assert scene_name(str(tmp_path / "church" / "images")) == "church"
    monkeypatch.setenv("HOME", str(tmp_path))
    assert scene_name("~/castle") == "castle"
    monkeypatch.chdir(tmp_path / "church")
    assert [scene_name(name) for name in (".", "images", "../castle/")] == ["church", "church", "castle"]


@pytest.mark.parametrize("value", [2024, datetime.date(2024, 5, 1)])
def test_what_looks_like_a_number_or_a_date_is_a_name(value: object) -> None:
    assert list(list_scenes(load_configuration({"images": "x", "scene": value}))) == [str(value)]
    free = [key for key, field in RunOptions.model_fields.items() if field.annotation is str]
    assert {"images", "cameras", "weights"} < set(free)
    for key in free:
        assert getattr(load_configuration({key: value}), key) == str(value)
    assert list(load_configuration({"scenes": {value: {"images": "x"}}}).scenes) == [str(value)]


def test_scenes_without_any_are_none() -> None:
    assert list(list_scenes(load_configuration({"scenes": None, "images": "x"}))) == ["x"]


def test_of_keys_that_are_typed_twice_the_last_counts() -> None:
    check_spelling({"images": 5}, ["images=1_0", "images=5"])
    check_spelling({"images": "1_0_"}, ["images=1_0_"])
    with pytest.raises(ConfigError, match=r"images=1_0 as the number 10: write images=\./1_0"):
        check_spelling({"images": 10}, ["images=5", "images=1_0"])
    with pytest.raises(ConfigError, match=r"scene=007 as the number 7: choose another name"):
        check_spelling({"scene": 7}, ["scene=007"])


def test_scenes_replace_images_and_both_are_refused() -> None:
    scenes = {"a": {"images": "x"}, "b": {"images": "y", "intrinsics": "refine"}}
    listed = list_scenes(load_configuration({"scenes": scenes}))
    assert list(listed) == ["a", "b"]
    assert listed["b"].intrinsics == "refine"
    with pytest.raises(ConfigError, match="not both"):
        list_scenes(load_configuration({"scenes": scenes, "images": "z"}))
    for key, value in {"cameras": "K.txt", "intrinsics": "refine", "reference": "r", "pairs": "p"}.items():
        with pytest.raises(ConfigError, match=f"'{key}' next to 'scenes' .* each scene"):
            list_scenes(load_configuration({"scenes": scenes, key: value}))


def test_a_scene_name_may_contain_what_snakemake_does_not_replace() -> None:
    for name in ("a<b", "a > b", "<1>", "<B>"):
        assert list(list_scenes(load_configuration({"images": "x", "scene": name}))) == [name]


@pytest.mark.parametrize("name", ["../up", ".hidden", "a/b", "a{b", "a<b>", "<results>"])
def test_a_scene_name_that_is_no_folder_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="scene=NAME"):
        list_scenes(load_configuration({"images": "x", "scene": name}))


def test_a_scene_name_that_is_too_long_for_a_folder_is_refused() -> None:
    # a letter of two bytes
    assert list(list_scenes(load_configuration({"images": "x", "scene": 127 * "ä"}))) == [127 * "ä"]
    with pytest.raises(ConfigError, match=r"255 bytes.*scene=NAME"):
        list_scenes(load_configuration({"images": "x", "scene": 128 * "ä"}))


@pytest.mark.parametrize("stage", STAGES)
def test_options_render_to_canonical_json_and_back(stage: str) -> None:
    options = options_class(stage)()
    text = options.canonical_json()
    assert options_class(stage)(**json.loads(text)) == options
    assert json.dumps(json.loads(text), sort_keys=True) == text


@given(st.permutations(["ratio", "method"]))
def test_canonical_json_does_not_depend_on_the_order_of_keys(keys: list[str]) -> None:
    cls = options_class("match_pairs")
    defaults = cls().model_dump()
    values = {key: defaults[key] for key in keys if key in defaults}
    assert cls(**values).canonical_json() == cls().canonical_json()
