"""The comparison's processes: what is measured of them, how they fail, and that COLMAP's mappers run."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from benchmarks.compare import methods
from benchmarks.compare.inputs import inputs_of
from benchmarks.compare.measure import CommandError, Cost, run_measured, run_operation
from benchmarks.compare.methods import colmap_front_end, colmap_map
from benchmarks.compare.peers import extract
from benchmarks.compare.run import describe_front_end
from benchmarks.compare.sets import ImageSet, read_sets
from snakesfm.errors import ConfigError
from snakesfm.evaluation.scores import score_model

IMAGES = 6


def measured(folder: Path, code: str, limit_s: float = 60.0):
    return run_measured([sys.executable, "-c", code], folder, folder / "log", limit_s)


def test_processor_time_and_memory_of_children_count(tmp_path: Path) -> None:
    inner = "x = bytearray(120 * 2**20); sum(range(2 * 10**7)); import time; time.sleep(0.5)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}])"
    cost = measured(tmp_path, code)
    assert 110.0 < cost.peak_mib < 400.0
    assert 0.05 < cost.cpu_seconds < 60.0
    assert 0.0 <= cost.others <= 1.0


@pytest.mark.parametrize(
    ("code", "limit_s", "reason"),
    [
        ("raise SystemExit('no /some/where/model was found')", 60.0, "failed: no model was found"),
        ("print('snakesfm: scene a failed: no pairs.'); exit('job failed')", 60.0, "failed: no pairs."),
        ("import os; os.kill(os.getpid(), 11)", 60.0, "crashed by SIGSEGV"),
        ("import time; time.sleep(60)", 0.5, "stopped at the limit of 0 s"),
    ],
)
def test_failures_say_what_happened_and_what_it_cost(
    tmp_path: Path, code: str, limit_s: float, reason: str
) -> None:
    with pytest.raises(CommandError) as error:
        measured(tmp_path, code, limit_s)
    assert str(error.value) == reason
    assert error.value.cost.seconds > 0


def test_an_operation_that_does_not_exist_fails(tmp_path: Path) -> None:
    with pytest.raises(CommandError, match="KeyError: 'paint'"):
        run_operation("paint", {}, tmp_path / "log", 60.0)


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of COLMAP's own making, with a database; its images are not needed."""
    folder = tmp_path_factory.mktemp("sets") / "synthetic"
    (folder / "images").mkdir(parents=True)
    (folder / "reference").mkdir()
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, IMAGES
    options.num_points3D = 100
    with pycolmap.Database.open(folder / "database.db") as database:
        pycolmap.synthesize_dataset(options, database).write_text(folder / "reference")
    (folder / "meta.yaml").write_text("known_intrinsics: true\nreference_source: gantry\n")
    return folder


@pytest.mark.parametrize("operation", ["map_incremental", "map_global"])
def test_colmaps_mappers_run_on_a_copy_of_a_database(
    synthetic: Path, tmp_path: Path, operation: str
) -> None:
    (image_set,) = read_sets(synthetic.parent, ["synthetic"])
    assert (image_set.known, image_set.truth) == (True, True)
    database = synthetic / "database.db"
    before = database.read_bytes()
    cost = colmap_map(operation, image_set, database, tmp_path / "run", False, 0, 1, 120.0)
    assert database.read_bytes() == before
    assert not (tmp_path / "run" / "database.db").exists()
    assert cost.cpu_seconds > 0
    metrics, _ = score_model(tmp_path / "run" / "model", image_set.reference)
    assert metrics["registered_images"] == IMAGES
    assert 99.0 < metrics["relative_pose_auc_1deg"] <= 100.0


def test_cameras_are_told_as_the_reference_has_them(synthetic: Path) -> None:
    (known,) = ImageSet(synthetic, True, True).camera_groups()
    (camera,) = pycolmap.Reconstruction(synthetic / "reference").cameras.values()
    assert (known["names"], known["mode"], known["model"]) == ([], "SINGLE", camera.model_name)
    assert known["params"] == camera.params.tolist()
    (withheld,) = read_sets(synthetic.parent, ["synthetic"], withhold_intrinsics=True)
    assert withheld == ImageSet(synthetic.resolve(), False, True)
    assert withheld.camera_groups() == [{"names": [], "mode": "SINGLE"}]
    assert ImageSet(synthetic, False, True).pinhole() is None


def test_unknown_cameras_are_shared_as_in_the_reference(tmp_path: Path) -> None:
    names = [f"{k}.jpg" for k in range(6)]
    (tmp_path / "images").mkdir()
    for name in names:
        (tmp_path / "images" / name).touch()
    cameras = "".join(f"{k} SIMPLE_PINHOLE 64 48 50 32 24\n" for k in (1, 2))
    poses = "".join(f"{k + 1} 1 0 0 0 0 0 0 {1 + k // 3} {name}\n\n" for k, name in enumerate(names[:5]))
    (tmp_path / "reference").mkdir()
    for file, text in (("cameras", cameras), ("images", poses), ("points3D", "")):
        (tmp_path / "reference" / f"{file}.txt").write_text(text)
    assert ImageSet(tmp_path, False, True).camera_groups() == [
        {"names": names[:3], "mode": "SINGLE"},
        {"names": names[3:5], "mode": "SINGLE"},
        {"names": names[5:], "mode": "PER_IMAGE"},
    ]


def test_inputs_are_a_sets_files_whether_its_intrinsics_are_given_and_what_else_counts(
    synthetic: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(synthetic, copy)
    before = inputs_of(ImageSet(synthetic, True, True), "4.2", 2)
    assert before == inputs_of(ImageSet(copy, True, True), "4.2", 2)
    (copy / "images" / "a.jpg").write_bytes(b"x")
    others = [
        inputs_of(ImageSet(copy, True, True), "4.2", 2),
        inputs_of(ImageSet(synthetic, False, True), "4.2", 2),
        inputs_of(ImageSet(synthetic, True, True), "4.22"),
        inputs_of(ImageSet(synthetic, True, True), "4.3", 2),
    ]
    assert len({before, *others}) == 5


def test_a_front_end_is_made_again_where_it_starts_from_something_else(
    synthetic: Path, tmp_path: Path, monkeypatch
) -> None:
    done = []

    def run(operation: str, arguments: dict, log: Path, limit_s: float) -> Cost:
        done.append(operation)
        return Cost(float(len(done)), 1.0, 1.0)

    monkeypatch.setattr(methods, "run_operation", run)
    known, withheld = ImageSet(synthetic, True, True), ImageSet(synthetic, False, True)
    front = tmp_path / "front"
    front.mkdir()
    # one that was stored without what it started from
    (front / "cost.json").write_text('{"extract": {"seconds": 9, "cpu_seconds": 9, "peak_mib": 9}}')
    for image_set, threads, runs in ((known, 2, 1), (known, 2, 1), (withheld, 2, 2), (withheld, 1, 3)):
        costs = colmap_front_end(image_set, front, threads, 60.0)
        assert done == ["extract", "match"] * runs
        assert [costs[name].seconds for name in ("extract", "match")] == [2 * runs - 1, 2 * runs]


def extracted(images: Path, database: Path, groups: list[dict]) -> list[tuple[int, str, float]]:
    """Camera's number, model and focal length of each image in the database, by name; all have keypoints."""
    extract(str(images), str(database), groups, 50, 1)
    with pycolmap.Database.open(database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        found = sorted(opened.read_all_images(), key=lambda image: image.name)
        assert all(opened.num_keypoints_for_image(image.image_id) > 0 for image in found)
    assert [image.name for image in found] == sorted(path.name for path in images.iterdir())
    taken = [cameras[image.camera_id] for image in found]
    return [(camera.camera_id, camera.model_name, camera.params[0]) for camera in taken]


def test_groups_of_cameras_are_extracted_at_once_and_keep_their_cameras(
    tmp_path: Path, monkeypatch
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    names = [f"{k}.png" for k in range(4)]
    rng = np.random.default_rng(0)
    for name in names:
        noise = Image.fromarray(rng.integers(0, 256, (12, 16), np.uint8))
        noise.resize((160, 120), Image.Resampling.BICUBIC).save(images / name)
    calls = []
    real = pycolmap.extract_features
    monkeypatch.setattr(pycolmap, "extract_features", lambda *a, **k: (calls.append(k), real(*a, **k)))
    shared, single = (
        {"mode": "SINGLE", "model": "SIMPLE_PINHOLE", "params": [focal, 80.0, 60.0]}
        for focal in (150.25, 99.5)
    )
    groups = [{"names": names[1:3], **shared}, {"names": names[:1], **single}]
    groups.append({"names": names[3:], "mode": "PER_IMAGE"})
    first, *middle, last = extracted(images, tmp_path / "several.db", groups)
    assert first[1:] == ("SIMPLE_PINHOLE", 99.5)
    assert middle == [(middle[0][0], "SIMPLE_PINHOLE", 150.25)] * 2
    assert last[1] == "SIMPLE_RADIAL" and len({first[0], middle[0][0], last[0]}) == 3
    one = extracted(images, tmp_path / "one.db", [{"names": [], **shared}])
    assert one == [(one[0][0], "SIMPLE_PINHOLE", 150.25)] * 4
    assert len(calls) == 2


def test_results_of_groups_that_were_extracted_one_after_the_other_are_made_again() -> None:
    assert describe_front_end(1) == pycolmap.__version__
    assert describe_front_end(10) == f"{pycolmap.__version__}, 10 groups of cameras at once"


@pytest.mark.parametrize(
    ("model", "is_pinhole"),
    [("PINHOLE 64 48 50 51 32 24", True), ("SIMPLE_RADIAL 64 48 50 32 24 0.1", False)],
)
def test_a_matrix_is_told_of_a_camera_without_distortion(
    tmp_path: Path, model: str, is_pinhole: bool
) -> None:
    for folder in ("images", "reference"):
        (tmp_path / "set" / folder).mkdir(parents=True)
    for part in ("images", "points3D"):
        (tmp_path / "set" / "reference" / f"{part}.txt").write_text("")
    (tmp_path / "set" / "reference" / "cameras.txt").write_text(f"1 {model}\n")
    matrix = [[50, 0, 32], [0, 51, 24], [0, 0, 1]]
    assert ImageSet(tmp_path / "set", True, True).pinhole() == (matrix if is_pinhole else None)
    # a reference is COLMAP's where nothing else is said
    (found,) = read_sets(tmp_path, ["set"])
    assert (found.known, found.truth) == (False, False)


def test_a_folder_that_is_no_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"lacking is not an image set: it needs images/ and reference/"):
        read_sets(tmp_path, ["lacking"])
