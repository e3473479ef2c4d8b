"""Faults of disks, files and clocks: each ends with the same model as an undisturbed run."""

import contextlib
import os
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from workflow_runner import Workflow, config_of, copy_run, model_bytes

pytestmark = pytest.mark.workflow


def half_written(output: Path) -> list[Path]:
    """Files that look finished or temporary and cannot be read."""
    broken = list(output.rglob("*.tmp"))
    for path in output.rglob("*.h5"):
        try:
            h5py.File(path, "r").close()
        except OSError:
            broken.append(path)
    return broken


@contextlib.contextmanager
def mounted(folder: Path, options: str) -> Iterator[None]:
    """A small disk of its own on a folder; the test is skipped where it cannot be had."""
    folder.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no disk can be mounted: {error}")
    if done.returncode:
        pytest.skip(f"no disk can be mounted: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_leaves_nothing_half_written(finished, small_scene: Path, workflow) -> None:
    disk = workflow.folder / "out"
    with mounted(disk, "size=1m"):
        full = workflow.run(*config_of(small_scene))
        assert full.status != 0
        assert "No space left on device" in full.text
        assert "free the disk" in full.text
        assert half_written(disk) == []
        subprocess.run(["mount", "-o", "remount,size=200m", str(disk)], check=True)
        again = workflow.run(*config_of(small_scene))
        assert again.status == 0, again.text
        assert "index_images" not in again.rules
        assert model_bytes(disk / "square") == model_bytes(finished[0])
        assert half_written(disk) == []


def test_a_read_only_output_folder_gives_one_sentence(small_scene: Path, workflow) -> None:
    with mounted(workflow.folder / "out", "ro"):
        outcome = workflow.run(*config_of(small_scene))
    assert outcome.status != 0
    assert "cannot be written" in outcome.text
    assert "output=DIR" in outcome.text
    assert "Traceback" not in outcome.text
    assert outcome.rules == []


def test_damaged_and_foreign_files_are_found_and_made_again(finished, small_scene: Path, workflow) -> None:
    """With the times that they had: Snakemake sees no difference."""
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    files = [
        output / "extract_features" / "0.h5",
        output / "estimate_two_view" / "1-1.h5",
        output / "average_rotations" / "rotations.h5",
        output / "average_translations" / "centers.h5",
        output / "triangulate_tracks" / "points.h5",
    ]
    times = {file: file.stat().st_mtime_ns for file in files}
    os.truncate(files[0], files[0].stat().st_size // 2)
    files[2].write_bytes(b"")
    for file, attribute, value in (
        (files[1], "options", "{}"),
        (files[3], "stage_version", 0),
        (files[4], "scene", "another"),
    ):
        with h5py.File(file, "r+") as content:
            content.attrs[attribute] = value
    for file, time_ns in times.items():
        os.utime(file, ns=(time_ns, time_ns))
    (output / "adjust_bundle" / "reconstruction.h5").unlink()
    first = workflow.run(*config_of(small_scene))
    assert first.status != 0
    assert "Traceback" not in first.text
    sentence = first.summary[-1]
    assert "(and 4 more)" in sentence
    assert "start the same command again" in sentence
    assert sorted(output.rglob("*.refused")) == sorted(
        file.with_name(f"{file.name}.refused") for file in files
    )
    second = workflow.run(*config_of(small_scene))
    assert second.status == 0, second.text
    assert model_bytes(output) == model_bytes(finished[0])
    assert half_written(output) == []


def test_a_page_lost_inside_a_file_is_found_by_who_reads_it(finished, small_scene: Path, workflow) -> None:
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    damaged = output / "match_pairs" / "0-1.h5"
    former = damaged.parent / ".former" / damaged.name
    former.parent.mkdir(exist_ok=True)
    former.unlink(missing_ok=True)
    os.link(damaged, former)
    times = damaged.stat()
    with h5py.File(damaged, "r+") as content:
        content["matches"][...] = 0
    os.utime(damaged, ns=(times.st_atime_ns, times.st_mtime_ns))
    for tile in (output / "estimate_two_view").glob("*.h5"):
        tile.unlink()
        (tile.parent / ".former" / tile.name).unlink(missing_ok=True)
    first = workflow.run(*config_of(small_scene))
    assert first.status != 0
    assert "Traceback" not in first.text
    assert "match_pairs/0-1.h5 is damaged" in first.summary[-1]
    # its former version is the same damaged file
    second = workflow.run(*config_of(small_scene))
    assert second.status == 0, second.text
    assert model_bytes(output) == model_bytes(finished[0])


def test_files_from_the_future_and_the_past_change_nothing(finished, small_scene: Path, workflow) -> None:
    """As nodes whose clocks are an hour wrong leave them."""
    copy_run(finished[0], workflow.folder)
    output = workflow.folder / "out" / "square"
    now = time.time()
    for stage, hours in (
        ("index_images", 1),
        ("extract_features", -1),
        ("match_pairs", 1),
        ("build_tracks", 1),
    ):
        for file in (output / stage).glob("*.h5"):
            os.utime(file, (now + 3600 * hours, now + 3600 * hours))
    (output / "export_model" / "summary.json").unlink()
    first = workflow.run(*config_of(small_scene))
    assert first.status == 0, first.text
    assert "export_model" in first.rules
    assert "files had times in the future" in first.text
    assert model_bytes(output) == model_bytes(finished[0])
    second = workflow.run(*config_of(small_scene))
    assert second.rules == []


def taken_over(scene: Path) -> dict[str, tuple[int, int]]:
    """Per job the images or pairs that it had, and how many of them it did not compute."""
    counts = {}
    for log in sorted(scene.glob("logs/*/*.log")):
        found = re.search(r"(\d+) (?:images|pairs) \((\d+) taken over\)", log.read_text())
        if found:
            counts[f"{log.parent.name}/{log.stem}"] = (int(found[1]), int(found[2]))
    return counts


def test_runs_share_features_and_matches_by_their_digests(small_scene: Path, workflow) -> None:
    shared = Workflow(
        workflow.folder, environment={**os.environ, "SNAKESFM_CACHE": str(workflow.folder / "shared")}
    )
    until = ["--until", "match_pairs"]
    first = shared.run(*until, *config_of(small_scene, output="first"))
    assert first.status == 0, first.text
    assert all(
        taken == 0 < count for count, taken in taken_over(workflow.folder / "first" / "square").values()
    )
    kept = sorted((workflow.folder / "shared").rglob("*.h5"))
    assert {path.parts[-3] for path in kept} == {"extract_features", "match_pairs"}
    damaged = next(path for path in kept if path.parts[-3] == "match_pairs")
    # as long as it was: a lost page changes no size
    size = damaged.stat().st_size
    damaged.unlink()
    damaged.write_bytes(b"damaged".ljust(size))
    second = shared.run(
        *until,
        *config_of(small_scene, output="second"),
        "scene=other",
        "average_rotations={max_residual_deg: 9}",
    )
    assert second.status == 0, second.text
    with h5py.File(damaged) as repaired:
        assert repaired.attrs["stage"] == "match_pairs"
    counts = taken_over(workflow.folder / "second" / "other")
    assert len(counts) == 5
    assert sum(taken == 0 for _, taken in counts.values()) == 1
    assert sum(taken == count for count, taken in counts.values()) == 4
    for stage in ("extract_features", "match_pairs"):
        for file in sorted((workflow.folder / "first" / "square" / stage).glob("*.h5")):
            with (
                h5py.File(file) as one,
                h5py.File(workflow.folder / "second" / "other" / stage / file.name) as two,
            ):
                assert sorted(one) == sorted(two)
                assert all((one[name][()] == two[name][()]).all() for name in one)
    made = workflow.folder / "second" / "other" / "match_pairs"
    assert damaged.read_bytes() in [file.read_bytes() for file in made.glob("*.h5")]
    other = shared.run(
        *until, *config_of(small_scene, output="third"), "extract_features={max_keypoints: 400}"
    )
    assert other.status == 0, other.text
    assert all(taken == 0 for _, taken in taken_over(workflow.folder / "third" / "square").values())


def test_a_shared_folder_that_cannot_be_used_is_only_a_warning(small_scene: Path, workflow) -> None:
    (workflow.folder / "file").write_text("no folder")
    environment = {**os.environ, "SNAKESFM_CACHE": str(workflow.folder / "file")}
    outcome = Workflow(workflow.folder, environment=environment).run(
        "--until", "extract_features", *config_of(small_scene)
    )
    assert outcome.status == 0, outcome.text
    log = (workflow.folder / "out" / "square" / "logs" / "extract_features" / "0.log").read_text()
    assert "could not be shared" in log
