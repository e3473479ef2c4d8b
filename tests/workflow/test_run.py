"""Whole runs on a small rendered scene: results, resuming, re-running, killing."""

import contextlib
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import cv2
import h5py
import numpy as np
import psutil
import pycolmap
import pytest
from workflow_runner import Workflow, config_of, copy_run, model_bytes

from benchmarks.compare.measure import Cost
from benchmarks.compare.methods import AFTER, GROUPS, job_counts, stage_costs
from snakesfm.artifacts import LocalFeatures, Reconstruction
from snakesfm.pipeline import STAGES
from snakesfm.start import NO_SERVER, VARIABLE

MAPPING = [
    "build_view_graph",
    "filter_view_graph",
    "average_rotations",
    "build_tracks",
    "average_translations",
    "triangulate_tracks",
    "adjust_bundle",
    "export_model",
    "evaluate_model",
    "render_report",
]
RESULTS = ["evaluate_model", "export_model", "render_report"]
pytestmark = pytest.mark.workflow


def color_errors(output: Path, images: Path) -> np.ndarray:
    """How far the colours (T,3) of exported points are from the mean pixel where images see them."""
    exported = pycolmap.Reconstruction(str(output / "export_model" / "sparse" / "0"))
    colors = [point.color for _, point in sorted(exported.points3D.items())]
    model = Reconstruction.read(output / "adjust_bundle" / "reconstruction.h5")
    pictures = np.stack([cv2.imread(str(path))[..., ::-1] for path in sorted(images.iterdir())])
    columns, rows = np.floor(model.keypoints).astype(int).T
    sums = np.add.reduceat(pictures[model.image_ids, rows, columns].astype(float), model.offsets[:-1])
    return np.abs(colors - sums / np.diff(model.offsets)[:, None])


def test_a_run_gives_a_model_that_others_can_read(finished, small_scene: Path) -> None:
    output, outcome = finished
    model = pycolmap.Reconstruction(str(output / "export_model" / "sparse" / "0"))
    assert model.num_reg_images() == 16
    model.update_point_3d_errors()
    assert 0.05 < model.compute_mean_reprojection_error() < 1.0
    for image in model.images.values():
        assert (output / "export_model" / "images" / image.name).is_file()
    frames = json.loads((output / "export_model" / "transforms.json").read_text())["frames"]
    assert len(frames) == 16
    metrics = json.loads((output / "evaluate_model" / "metrics.json").read_text())
    assert metrics["registered_images"] == 16
    assert np.median(color_errors(output, small_scene / "images"), axis=0).max() < 5
    assert (output / "render_report" / "index.html").stat().st_size > 2000
    line = outcome.summary[-1]
    for part in ("'square'", "16 of 16 images", "points", "px", str(Path("out") / "square")):
        assert part in line


def test_a_run_is_accurate(finished) -> None:
    metrics = json.loads((finished[0] / "evaluate_model" / "metrics.json").read_text())
    assert 85.0 < metrics["relative_pose_auc_1deg"] <= 100.0
    assert 94.0 < metrics["relative_pose_auc_5deg"] <= 100.0


def test_every_stage_says_what_it_is_in_its_artifacts(finished) -> None:
    for file in finished[0].rglob("*.h5"):
        with h5py.File(file) as content:
            stage = content.attrs["stage"]
            assert stage in STAGES
            assert stage in file.parts
            assert content.attrs["scene"] == "square"
            json.loads(content.attrs["options"])


def test_a_second_run_does_nothing(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    outcome = workflow.run(*config_of(small_scene))
    assert outcome.status == 0
    assert outcome.rules == []
    assert "Nothing to be done" in outcome.text


def test_touched_images_and_scripts_change_nothing(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    for image in (small_scene / "images").iterdir():
        image.touch()
    outcome = workflow.run(*config_of(small_scene))
    assert outcome.rules == []


def test_a_deleted_tile_is_made_again_with_what_depends_on_it_alone(
    finished, small_scene: Path, workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    (output / "match_pairs" / "0-1.h5").unlink()
    outcome = workflow.run(*config_of(small_scene))
    assert outcome.status == 0, outcome.text
    assert sorted(outcome.rules) == sorted(
        ["match_pairs", "calibrate_cameras", *["estimate_two_view"] * 3, *MAPPING]
    )
    assert model_bytes(output) == model_bytes(finished[0])
    log = (output / "logs" / "match_pairs" / "0-1.log").read_text()
    assert re.search(r"([1-9]\d*) pairs \(\1 taken over\)", log)


def test_a_lost_model_or_table_or_link_to_the_images_is_made_again(
    finished, small_scene: Path, workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    shutil.rmtree(output / "export_model" / "sparse")
    (output / "evaluate_model" / "metrics.csv").unlink()
    outcome = workflow.run(*config_of(small_scene))
    assert outcome.status == 0, outcome.text
    assert sorted(outcome.rules) == ["evaluate_model", "export_model", "render_report"]
    assert model_bytes(output) == model_bytes(finished[0])
    assert (output / "evaluate_model" / "metrics.csv").is_file()
    # moved to another depth, a relative link leads nowhere
    moved = Workflow(workflow.folder / "deep" / "er")
    moved.folder.mkdir(parents=True)
    for name in ("out", ".snakemake"):
        (workflow.folder / name).rename(moved.folder / name)
    images = moved.folder / "out" / "square" / "export_model" / "images"
    assert not images.exists()
    again = moved.run(*config_of(small_scene))
    assert again.status == 0, again.text
    assert sorted(again.rules) == ["export_model", "render_report"]
    assert images.resolve() == (small_scene / "images").resolve()
    assert moved.run(*config_of(small_scene)).rules == []


def test_an_option_reaches_its_stage_and_what_follows_alone(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    outcome = workflow.run("--dry-run", *config_of(small_scene), "adjust_bundle={max_iterations: 77}")
    assert sorted(set(outcome.rules)) == sorted(MAPPING[6:])


def test_masked_parts_of_images_take_no_part(finished, small_scene: Path, workflow) -> None:
    """The images are reduced, too."""
    copy_run(finished[0], workflow.folder)
    config = config_of(small_scene, "masks=masks", "extract_features={max_shorter_side_px: 150}")
    masks = workflow.folder / "masks"
    masks.mkdir()
    names = sorted(path.name for path in (small_scene / "images").iterdir())
    for name in names[:-1]:
        mask = np.full((300, 400), 255, np.uint8)
        mask[:, 360:] = 0
        cv2.imwrite(str(masks / f"{name}.png"), mask)
    output = workflow.folder / "out" / "square"
    outcome = workflow.run(*config)
    assert outcome.status == 0, outcome.text
    assert "index_images" not in outcome.rules and "extract_features" in outcome.rules
    for path in (workflow.folder / "out" / "square" / "extract_features").glob("*.h5"):
        features = LocalFeatures.read(path)
        for row, name in enumerate(features.names):
            x = features.keypoints[features.offsets[row] : features.offsets[row + 1], 0]
            assert len(x) > 20 and (x.max() < 360) == (name != names[-1])
    log = (workflow.folder / "out" / "square" / "logs" / "extract_features" / "0.log").read_text()
    assert re.search(r"(\d+) images \(\d taken over\), \d+ of them with masks", log)
    metrics = json.loads((output / "evaluate_model" / "metrics.json").read_text())
    assert metrics["registered_images"] == 16
    assert 90.0 < metrics["relative_pose_auc_5deg"] < 99.0
    assert np.median(color_errors(output, small_scene / "images"), axis=0).max() < 5
    log = (output / "logs" / "adjust_bundle" / "job.log").read_text()
    refined, of = map(int, re.search(r"keypoints refined: (\d+) of (\d+)", log).groups())
    assert 0.8 * of < refined <= of
    again = workflow.run(*config)
    assert again.status == 0 and again.rules == [], again.text
    # they are told by content where there is no record, too
    for changed, made in ((False, 0), (True, len(list((output / "extract_features").glob("*.h5"))))):
        shutil.rmtree(workflow.folder / ".snakemake")
        if changed:
            cv2.imwrite(str(masks / f"{names[0]}.png"), mask[:, ::-1])
        unrecorded = workflow.run("--until", "extract_features", *config)
        assert unrecorded.status == 0, unrecorded.text
        assert unrecorded.rules.count("extract_features") == made
        assert len(list(output.rglob("*.refused"))) == made
        assert unrecorded.rules.count("index_images") == 0
    features = [LocalFeatures.read(path) for path in (output / "extract_features").glob("*.h5")]
    (first,) = [part for part in features if names[0] in part.names]
    row = list(first.names).index(names[0])
    assert first.keypoints[first.offsets[row] : first.offsets[row + 1], 0].min() >= 40


def test_a_folder_without_records_is_taken_over_unless_its_options_differ(
    finished, small_scene: Path, workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    shutil.rmtree(workflow.folder / ".snakemake")
    same = workflow.run(*config_of(small_scene))
    # these do not say of themselves how they were made
    assert same.status == 0 and sorted(same.rules) == RESULTS, same.text
    other = [*config_of(small_scene), "build_tracks={min_length: 4}"]
    output = workflow.folder / "out" / "square"
    before = model_bytes(output)
    assert workflow.run("--dry-run", *other).status == 0 and model_bytes(output) == before
    changed = workflow.run(*other)
    assert changed.status == 0, changed.text
    assert "1 files without a record in this folder's .snakemake" in changed.text
    assert {"build_tracks", "triangulate_tracks", "adjust_bundle", "export_model"} <= set(changed.rules)
    assert not {"extract_features", "match_pairs", "average_rotations"} & set(changed.rules)
    assert (output / "build_tracks" / "tracks.h5.refused").is_file()
    again = workflow.run(*other)
    assert again.status == 0 and again.rules == [], again.text


def test_a_file_that_was_made_from_another_folder_is_not_taken_for_this_one_s(
    finished, small_scene: Path, workflow
) -> None:
    copy_run(finished[0], workflow.folder)
    here = config_of(small_scene)
    there = [*here[:-1], f"output={workflow.folder / 'out'}", "build_tracks={min_length: 4}"]
    output = workflow.folder / "out" / "square"
    before = model_bytes(output)
    assert workflow.run(*there).status == 0
    assert model_bytes(output) != before
    # the records under the first name are of files that are no more
    again = workflow.run(*here)
    assert again.status == 0, again.text
    assert {"build_tracks", "adjust_bundle", *RESULTS} <= set(again.rules)
    assert model_bytes(output) == before
    assert workflow.run(*here).rules == []


@pytest.mark.parametrize(("change", "refused"), [("an image", 1), ("the seed", 20)])
def test_a_folder_without_records_is_held_against_its_images_and_seed(
    finished, small_scene: Path, workflow, change: str, refused: int
) -> None:
    copy_run(finished[0], workflow.folder)
    shutil.rmtree(workflow.folder / ".snakemake")
    scene = workflow.folder / "square"
    shutil.copytree(small_scene, scene)
    config = [*config_of(scene), "scene=square"]
    if change == "an image":
        images = sorted((scene / "images").iterdir())
        shutil.copy(images[3], images[4])
    else:
        config.append("seed=1")
    outcome = workflow.run("--until", "index_images", *config)
    assert outcome.status == 0, outcome.text
    assert outcome.rules.count("index_images") == 1
    assert len(list((workflow.folder / "out").rglob("*.refused"))) == refused


def test_an_added_image_is_indexed(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    scene = workflow.folder / "square"
    shutil.copytree(small_scene, scene)
    images = sorted((scene / "images").iterdir())
    shutil.copy(images[3], scene / "images" / "zz_copy.jpg")
    outcome = workflow.run("--dry-run", *config_of(scene), "scene=square")
    assert outcome.rules.count("index_images") == 1


def test_a_run_that_is_killed_again_and_again_ends_with_the_same_model(
    finished, small_scene: Path, workflow
) -> None:
    """Each time in a later stage; the last start goes on to the end."""
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    stages = {
        "extract_features": signal.SIGKILL,
        "match_pairs": signal.SIGKILL,
        "adjust_bundle": signal.SIGTERM,
    }
    for stage in stages:
        shutil.rmtree(output / stage)
        shutil.rmtree(output / "logs" / stage)
    for stage, number in stages.items():
        made = expected = len(list((finished[0] / stage).glob("*.h5")))
        attempts = 0
        # on a busy machine the stage may end before its start is noticed
        while made == expected and attempts < 3:
            attempts += 1
            shutil.rmtree(output / stage, ignore_errors=True)
            shutil.rmtree(output / "logs" / stage, ignore_errors=True)
            workflow.kill_when(
                # TERM before the job runs would let it run to its end
                lambda logs=output / "logs" / stage: any(log.stat().st_size for log in logs.glob("*.log")),
                *config_of(small_scene),
                number=number,
            )
            made = len(list((output / stage).glob("[!.]*.h5")))
        assert made < expected
    outcome = workflow.run(*config_of(small_scene))
    assert outcome.status == 0, outcome.text
    assert {"adjust_bundle", *RESULTS} <= set(outcome.rules)
    # what was made before a kill is kept
    assert not {"index_images", "extract_features", "match_pairs"} & set(outcome.rules)
    assert model_bytes(output) == model_bytes(finished[0])
    assert not list(output.rglob("*.tmp"))


def test_two_runs_at_once_on_one_output_are_refused(finished, small_scene: Path, workflow) -> None:
    import fcntl

    copy_run(finished[0], workflow.folder)
    (workflow.folder / "out" / "square" / "render_report" / "index.html").unlink()
    with (workflow.folder / "out" / ".snakesfm.lock").open("w") as lock:
        lock.write("process 1 on elsewhere")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        outcome = workflow.run(*config_of(small_scene))
        deleted = workflow.run("--delete-all-output", *config_of(small_scene))
        pretended = workflow.run("--delete-all-output", "-n", *config_of(small_scene))
    for refused in (outcome, deleted):
        assert refused.status != 0
        assert "Another run (process 1 on elsewhere)" in refused.text
        assert "Traceback" not in refused.text
        assert refused.rules == []
    # what deletes nothing is no harm beside a run
    assert pretended.status == 0, pretended.text
    model = workflow.folder / "out" / "square" / "export_model" / "sparse" / "0" / "points3D.bin"
    assert model.is_file()
    alone = workflow.run("--delete-all-output", *config_of(small_scene))
    assert alone.status == 0, alone.text
    assert not model.exists()


def test_logs_say_what_the_jobs_cost(finished) -> None:
    costs = stage_costs(finished[0] / "logs", Cost(600.0, 600.0, 0.0))
    for name in ("extract", "match", "map"):
        assert 0.0 < costs[name].seconds < 600.0
        assert 0.0 < costs[name].cpu_seconds < 600.0
        assert 20.0 < costs[name].peak_mib < 4000.0
    stages = [log.parent.name for log in (finished[0] / "logs").glob("*/*.log")]
    counts = {name: sum(map(stages.count, group)) for name, group in {**GROUPS, "after": AFTER}.items()}
    assert counts == job_counts(16)
    assert sum(counts.values()) == len(stages)


def check_same_model(output: Path, expected: Path) -> None:
    first = Reconstruction.read(expected / "adjust_bundle" / "reconstruction.h5")
    second = Reconstruction.read(output / "adjust_bundle" / "reconstruction.h5")
    np.testing.assert_array_equal(first.rotations, second.rotations)
    np.testing.assert_array_equal(first.translations, second.translations)
    np.testing.assert_array_equal(first.points, second.points)
    assert model_bytes(output) == model_bytes(expected)


def test_jobs_are_forked_and_blocks_cores_and_order_do_not_change_the_model(
    finished, small_scene: Path, workflow
) -> None:
    """The undisturbed run has 2 blocks and 2 jobs at once."""
    forks = set()
    environment = {**os.environ, "TMPDIR": str(workflow.folder)}
    with Workflow(workflow.folder, environment=environment).start(
        *config_of(small_scene, "blocks=5"), "--quiet", "all", cores=8
    ) as run:
        while run.poll() is None:
            with contextlib.suppress(psutil.Error):
                for server in psutil.Process(run.pid).children():
                    if "snakesfm.job_server" in server.cmdline():
                        forks.update(fork.pid for fork in server.children())
            time.sleep(0.01)
        assert run.returncode == 0, run.stdout.read()
    assert len(forks) >= len(MAPPING) // 2
    assert list(workflow.folder.glob("snakesfm-*")) == []
    check_same_model(workflow.folder / "out" / "square", finished[0])


def test_jobs_of_their_own_one_at_a_time_make_the_same_model(finished, small_scene: Path, workflow) -> None:
    alone = Workflow(workflow.folder, environment={**os.environ, VARIABLE: NO_SERVER}).run(
        *config_of(small_scene, "blocks=3"), cores=1
    )
    assert alone.status == 0, alone.text
    assert len(alone.rules) > len(MAPPING)
    check_same_model(workflow.folder / "out" / "square", finished[0])
