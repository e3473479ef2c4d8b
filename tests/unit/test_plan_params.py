"""What a stage is told by the plan: it follows what is given to the run, not when or where."""

import json
from pathlib import Path

import pytest
from planned_images import make_images, plan_of

from snakesfm.config.configuration import options_class
from snakesfm.digests import file_digest, model_digest, settings_text
from snakesfm.pipeline import STAGES
from snakesfm.plan import Plan
from snakesfm.scene_plan import PROVISIONAL_STAGES


def params_of(config: dict[str, str]) -> dict[str, str]:
    """The params of every stage's job, of its first block or tile, as a new run has them."""
    file_digest.cache_clear()
    model_digest.cache_clear()
    scene = Plan(config).scenes["scene"]
    parts = {"block": "0", "tile": "0-0"}
    return {stage: scene.params(stage, parts, True) for stage in STAGES}


def test_params_are_canonical_and_follow_content_not_time(tmp_path: Path) -> None:
    folder = make_images(tmp_path / "scene", 3)
    first = plan_of(tmp_path, images=str(folder)).scenes["scene"].params("index_images", {}, True)
    for image in folder.iterdir():
        image.touch()
    again = plan_of(tmp_path, images=str(folder)).scenes["scene"].params("index_images", {}, True)
    (folder / "001.jpg").write_bytes(b"other bytes")
    changed = plan_of(tmp_path, images=str(folder)).scenes["scene"].params("index_images", {}, True)
    assert first == again != changed
    assert json.dumps(json.loads(first), sort_keys=True) == first


@pytest.mark.parametrize(
    ("changed", "stages"),
    [
        ("scene/001.jpg", {"index_images"}),
        ("cameras/cameras.txt", {"index_images"}),
        ("cameras/images.txt", {"index_images"}),
        ("masks/001.jpg.png", {"extract_features"}),
        ("pairs.txt", {"select_pairs"}),
        ("reference/images.txt", {"evaluate_model"}),
        ("reference/points3D.txt", {"evaluate_model"}),
    ],
)
def test_other_bytes_of_a_given_file_change_what_its_stage_is_told(
    tmp_path: Path, changed: str, stages: set[str]
) -> None:
    make_images(tmp_path / "scene", 3)
    config = {"images": str(tmp_path / "scene"), "output": str(tmp_path / "out")}
    names = ("cameras/cameras.txt", "masks", "pairs.txt", "reference")
    config |= {Path(name).parts[0].split(".")[0]: str(tmp_path / name) for name in names}
    model = [f"reference/{part}.txt" for part in ("cameras", "images", "points3D")]
    for name in ("cameras/cameras.txt", "cameras/images.txt", "masks/001.jpg.png", "pairs.txt", *model):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        # runs refuse known cameras that are none
        (tmp_path / name).write_text("1 PINHOLE 640 480 500 500 320 240\n")
    before = params_of(config)
    (tmp_path / changed).write_text("1 PINHOLE 640 480 600 600 320 240\n")
    after = params_of(config)
    assert {stage for stage in STAGES if before[stage] != after[stage]} == stages


@pytest.mark.parametrize(
    ("front_end", "changed", "stages"),
    [
        ("imported", "hloc/features.h5", {"extract_features"}),
        ("imported", "hloc/matches.h5", {"match_pairs", "select_pairs"}),
        ("virtual", "model/points3D.txt", {"extract_features", "evaluate_model"}),
        ("virtual_places", "model/points3D.txt", {"match_pairs", "evaluate_model"}),
    ],
)
def test_other_bytes_of_what_a_front_end_reads_change_what_its_stage_is_told(
    tmp_path: Path, front_end: str, changed: str, stages: set[str]
) -> None:
    make_images(tmp_path / "scene", 3)
    for name in ("hloc/features.h5", "hloc/matches.h5", "model/cameras.txt", "model/images.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"bytes")
    (tmp_path / "model/points3D.txt").write_bytes(b"bytes")
    config = {"images": str(tmp_path / "scene"), "output": str(tmp_path / "out"), "front_end": front_end}
    key, folder = ("imported", "hloc") if front_end == "imported" else ("reference", "model")
    config[key] = str(tmp_path / folder)
    before = params_of(config)
    # as many bytes as before
    (tmp_path / changed).write_bytes(b"other")
    after = params_of(config)
    assert {stage for stage in STAGES if before[stage] != after[stage]} == stages


@pytest.mark.parametrize(
    ("key", "value", "stages"),
    [
        ("intrinsics", "refine", {"adjust_bundle", "export_model"}),
        ("index_images", {"camera_model": "OPENCV"}, {"index_images", "adjust_bundle"}),
        ("average_rotations", {"min_component_images": 9}, {"average_rotations", "average_translations"}),
        ("blocks", 3, {"index_images", "select_pairs"}),
        ("seed", 1, set(STAGES)),
        ("device", "cpu", set()),
        ("batch_size", 2, set()),
    ],
)
def test_a_key_reaches_the_stages_that_it_is_for(
    tmp_path: Path, key: str, value: object, stages: set[str]
) -> None:
    make_images(tmp_path / "scene", 3)
    (tmp_path / "K.txt").write_text("500 0 320\n0 500 240\n0 0 1\n")
    config = {"images": str(tmp_path / "scene"), "cameras": str(tmp_path / "K.txt")}
    config["output"] = str(tmp_path / "out")
    before, after = params_of(config), params_of({**config, key: value})
    assert {stage for stage in STAGES if before[stage] != after[stage]} == stages


def test_a_link_to_images_that_is_turned_is_noticed_by_the_export_alone(tmp_path: Path) -> None:
    for name in ("one", "two"):
        make_images(tmp_path / name, 3)
    config = {"images": str(tmp_path / "scene"), "output": str(tmp_path / "out")}
    told = []
    for name in ("one", "two"):
        (tmp_path / "scene").unlink(missing_ok=True)
        (tmp_path / "scene").symlink_to(name)
        told.append(params_of({**config, "scene": "scene"}))
    # the images are the same
    assert {stage for stage in STAGES if told[0][stage] != told[1][stage]} == {"export_model"}


def test_paths_may_begin_with_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bash leaves the mark of it as it is in ``images=~/photos``."""
    monkeypatch.setenv("HOME", str(tmp_path))
    make_images(tmp_path / "scene", 3)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "001.jpg.png").write_bytes(b"mask")
    (tmp_path / "pairs.txt").write_text("000.jpg 001.jpg\n000.jpg 002.jpg\n")
    (tmp_path / "K.txt").write_text("500 0 320\n0 500 240\n0 0 1\n")
    (tmp_path / "model").mkdir()
    for part in ("cameras", "images", "points3D"):
        (tmp_path / "model" / f"{part}.txt").write_text(part)
    files = {
        "images": "scene",
        "output": "out",
        "masks": "masks",
        "pairs": "pairs.txt",
        "cameras": "K.txt",
        "reference": "model",
        "weights": "weights",
    }
    file_digest.cache_clear()
    long, short = (
        Plan({key: f"{home}/{name}" for key, name in files.items()}).scenes["scene"]
        for home in (tmp_path, "~")
    )
    for name in ("images", "masks", "folder", "weights", "image_count", "pair_count"):
        assert getattr(short, name) == getattr(long, name)
    assert long.pair_count == 2
    parts = {"block": "0", "tile": "0-0"}
    for stage in STAGES:
        told = [scene.settings(stage, parts, True) for scene in (long, short)]
        # some stages look for the home folder themselves
        shown = [{key: str(value).replace("~", str(tmp_path)) for key, value in of.items()} for of in told]
        assert shown[0] == shown[1]


@pytest.mark.parametrize("stage", STAGES)
def test_another_version_of_a_stage_changes_what_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    make_images(tmp_path / "scene", 3)
    config = {"images": str(tmp_path / "scene"), "output": str(tmp_path / "out")}
    before = params_of(config)
    monkeypatch.setattr(options_class(stage), "stage_version", 999)
    after = params_of(config)
    # the provisional model is made by others' code
    calibration = {"calibrate_cameras"} if stage in PROVISIONAL_STAGES else set()
    assert {other for other in STAGES if before[other] != after[other]} == {stage} | calibration


def test_settings_of_another_seed_are_others() -> None:
    assert settings_text({}, 1) == settings_text({"images": "elsewhere"}, 1) != settings_text({}, 2)


@pytest.mark.parametrize(
    "keys",
    [
        {"masks": "masks", "pairs": "pairs.txt", "cameras": "K.txt", "reference": "model"},
        {"imported": "hloc", "front_end": "imported"},
        {"reference": "model", "front_end": "virtual"},
        {"weights": "weights", "front_end": "loftr"},
    ],
)
def test_artifacts_are_known_again_where_everything_was_moved(tmp_path: Path, keys: dict[str, str]) -> None:
    before = make_images(tmp_path / "here" / "scene", 3).parent
    for folder in ("masks", "model", "hloc", "weights"):
        (before / folder).mkdir()
    (before / "masks" / "001.jpg.png").write_bytes(b"mask")
    (before / "pairs.txt").write_text("000.jpg 001.jpg\n")
    (before / "K.txt").write_text("500 0 320\n0 500 240\n0 0 1\n")
    for part in ("cameras", "images", "points3D"):
        (before / "model" / f"{part}.txt").write_text(part)
    for part in ("features", "matches"):
        (before / "hloc" / f"{part}.h5").write_text(part)

    def texts(folder: Path) -> dict[str, str]:
        paths = {key: name if key == "front_end" else str(folder / name) for key, name in keys.items()}
        plan = Plan({"images": str(folder / "scene"), "output": str(folder / "out"), **paths})
        (scene,) = plan.scenes.values()
        names = {"extract_features": "0", "merge_keypoints": "0", "describe_images": "0"}
        return {
            stage: scene.settings_text(stage, Path(f"{names.get(stage, '0-0')}.h5")) for stage in STAGES
        }

    told = texts(before)
    assert texts(before.rename(tmp_path / "there")) == told


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
@pytest.mark.parametrize(
    ("changed", "counts"),
    [
        ("cameras.bin", True),
        ("points3D.bin", True),
        ("frames.bin", True),
        ("project.txt", False),
        ("stereo/depth_maps/a.bin", False),
    ],
)
def test_of_a_reference_only_the_files_of_its_model_count(
    tmp_path: Path, place: str, changed: str, counts: bool
) -> None:
    folder = tmp_path / place
    for name in ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin", changed):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"content")
    before = model_digest(str(tmp_path))
    (folder / changed).write_bytes(b"Content")
    model_digest.cache_clear()
    assert (model_digest(str(tmp_path)) != before) == counts


def test_of_a_folder_with_known_cameras_these_and_the_lists_beside_count(tmp_path: Path) -> None:
    digests = []
    for name in ("cameras.txt", "images.txt", "points3D.txt", "K.txt"):
        (tmp_path / name).write_text(f"content of {name}")
        file_digest.cache_clear()
        digests.append(file_digest(str(tmp_path), "images.txt", "images.bin"))
    assert len(set(digests[:2])) == 2 and digests[1] == digests[2] == digests[3]
    assert file_digest(str(tmp_path / "cameras.txt"), "images.txt") == digests[1]
    assert file_digest("") == model_digest("") == ""
