"""What jobs ask a cluster for."""

from pathlib import Path
from typing import Literal

import pytest
import yaml

from snakesfm.blocks import choose_blocks
from snakesfm.config.select_pairs import SelectPairsOptions
from snakesfm.pipeline import STAGES
from snakesfm.resources import (
    FOLLOWING_MIN,
    NEEDS,
    START_MIN,
    UNDISTORTED_MB,
    UNDISTORTED_S,
    UNDISTORTING_THREADS,
    Load,
    job_load,
    memory_mb,
    runtime_min,
    start_min,
)

ASKING = (memory_mb, runtime_min)


def test_every_stage_has_a_need() -> None:
    assert set(NEEDS) == set(STAGES)


@pytest.mark.parametrize("stage", STAGES)
def test_more_work_and_further_attempts_never_ask_for_less(stage: str) -> None:
    small, large = Load(10, 45), Load(5_000, 100_000)
    for ask in ASKING:
        assert 0 < ask(stage, small) <= ask(stage, large)
        assert ask(stage, large, 2) == 2 * ask(stage, large)
        assert ask(stage, large, 3) == 4 * ask(stage, large)


@pytest.mark.parametrize("stage", STAGES)
def test_needs_grow_with_the_scene(stage: str) -> None:
    small, large = job_load(stage, 100, 4, 1200), job_load(stage, 10_000, 32, 120_000)
    assert 300 <= memory_mb(stage, small) <= memory_mb(stage, large)
    assert 10 <= runtime_min(stage, small) <= runtime_min(stage, large)


def test_pairs_are_dealt_to_the_tiles() -> None:
    assert job_load("match_pairs", 1000, 8, 3600) == Load(250, 100)
    assert job_load("match_pairs", 1000, 1, 3600) == Load(1000, 3600)
    # a block of four is in seven of sixteen halves of tiles
    assert job_load("merge_keypoints", 1000, 4, 3200) == Load(250, 1400)
    assert job_load("merge_keypoints", 1000, 1, 3600) == Load(1000, 3600)
    assert job_load("extract_features", 1000, 4, 3200) == Load(250, 0)


@pytest.mark.parametrize("stage", STAGES)
def test_small_scenes_fit_a_laptop_and_large_ones_a_node(stage: str) -> None:
    assert 500 <= memory_mb(stage, Load(50, 1225)) <= 3_000
    assert memory_mb(stage, Load(10_000, 120_000)) <= 100_000
    assert 15 <= runtime_min(stage, Load(50, 1225)) <= 30


@pytest.mark.parametrize("stage", STAGES)
def test_the_page_on_clusters_names_the_needs(root: Path, stage: str) -> None:
    need = NEEDS[stage]
    numbers = (need.constant_mb, need.image_mb, need.pair_mb, need.image_s, need.pair_s)
    row = f"| `{stage}` | {need.grain} | " + " | ".join(f"{number:g}" for number in numbers) + " |"
    assert row in (root / "docs" / "cluster.md").read_text()


@pytest.mark.parametrize("images", [250, 1000, 2000, 5000])
def test_the_guide_says_what_groups_of_jobs_ask_for(root: Path, images: int) -> None:
    options = SelectPairsOptions().resolve(images)
    proposed = options.count_proposed(images)
    chosen, blocks = options.count_chosen(images, proposed), choose_blocks(images)
    loads = {
        stage: job_load(stage, images, blocks, proposed if stage == "select_pairs" else chosen)
        for stage in STAGES
    }
    groups = yaml.safe_load((root / "profiles" / "slurm" / "profile.yaml").read_text())["groups"]
    mb = {stage: memory_mb(stage, loads[stage]) for stage in STAGES}
    minutes = {stage: runtime_min(stage, loads[stage], start=start_min(stage, groups)) for stage in STAGES}
    first, last = STAGES.index("build_view_graph"), STAGES.index("adjust_bundle")
    mapping, unused = STAGES[first : last + 1], {"merge_keypoints", "index_matches"}
    # Snakemake adds what jobs that can run side by side ask for, and the times of those that follow
    mapping_min = sum(minutes[stage] for stage in mapping)
    finish_mb = max(mb["export_model"] + mb["evaluate_model"], mb["render_report"])
    finish_min = max(minutes["export_model"], minutes["evaluate_model"]) + minutes["render_report"]
    if not options.needs_descriptors:
        unused |= {"learn_vocabulary", "describe_images"}
    others = [stage for stage in STAGES[:first] if stage not in unused]
    least, most = (pick(mb[stage] for stage in others) / 1000 for pick in (min, max))
    shortest, longest = (pick(minutes[stage] for stage in others) for pick in (min, max))
    tiles = blocks * (blocks + 1) // 2
    # index_images, select_pairs, calibrate_cameras and the two groups
    jobs = 5 + blocks + 2 * tiles + (1 + blocks) * options.needs_descriptors
    cells = [
        str(jobs),
        f"{max(mb[stage] for stage in mapping) / 1000:.1f} GB, {mapping_min // 60} h {mapping_min % 60} min",
        f"{finish_mb / 1000:.1f} GB, {finish_min} min",
        f"{least:.1f} to {most:.1f} GB, {shortest} to {longest} min",
    ]
    lines = (root / "docs" / "guide.md").read_text().splitlines()
    (row,) = [line for line in lines if line.startswith(f"| {images:,} | ")]
    assert row.strip("| ").split(" | ")[2:] == cells


@pytest.mark.parametrize(("side", "measured_mb"), [(760, 265), (1520, 864), (2200, 1739), (3000, 3180)])
def test_larger_images_ask_for_what_they_take(side: int, measured_mb: int) -> None:
    for networks in (0, 1):
        usual, load = (
            job_load("extract_features", 400, 4, 3000, networks, shorter_side_px=pixels)
            for pixels in (760, side)
        )
        before, after = (runtime_min("extract_features", job) - START_MIN for job in (usual, load))
        assert (before - 1) * load.area < after <= before * load.area + 1
    load = job_load("extract_features", 100, 4, 3000, shorter_side_px=side)
    assert 1.5 * measured_mb < memory_mb("extract_features", load) < 8 * measured_mb
    huge = job_load("extract_features", 100, 4, 3000, shorter_side_px=20_000)
    assert memory_mb("extract_features", huge) < 30_000
    assert job_load("match_pairs", 100, 4, 3000, shorter_side_px=side).area == 1.0


def test_of_stages_in_one_job_the_first_takes_the_time_of_the_start() -> None:
    groups = {"match_pairs": "a", "build_view_graph": "b", "build_tracks": "b", "export_model": "c"}
    starts = [start_min(stage, groups) for stage in (*groups, "average_rotations")]
    assert starts == [START_MIN, START_MIN, FOLLOWING_MIN, START_MIN, START_MIN]
    load = Load(100, 1000)
    first, following = (runtime_min("build_tracks", load, 2, minutes) for minutes in starts[1:3])
    assert first - following == 2 * (START_MIN - FOLLOWING_MIN)


def test_more_keypoints_ask_for_more_memory() -> None:
    def ask(stage: str, most: int | Literal["auto"]) -> int:
        return memory_mb(stage, job_load(stage, 1000, 4, 20_000, max_keypoints=most))

    for stage in STAGES:
        assert ask(stage, "auto") == ask(stage, 5000) == ask(stage, 100) <= ask(stage, 20_000)
    # 4.5 MB of each of 1000 images, and what is held of 256
    assert ask("adjust_bundle", 20_000) - ask("adjust_bundle", 5000) > 3 * 4500
    assert ask("match_pairs", 20_000) - ask("match_pairs", 5000) > 3 * 160


def test_a_network_asks_for_more() -> None:
    for stage, pairs in (("extract_features", 0), ("match_pairs", 300)):
        without, with_one = (job_load(stage, 40, 2, pairs, networks) for networks in (0, 1))
        assert memory_mb(stage, with_one) == memory_mb(stage, without) + 2600
        assert 1 < runtime_min(stage, with_one) - runtime_min(stage, without) < 60
        assert memory_mb(stage, job_load(stage, 40, 2, pairs, 1, 3)) == memory_mb(stage, without) + 7800


@pytest.mark.parametrize("threads", [1, UNDISTORTING_THREADS, 16])
def test_undistorted_images_ask_for_their_time_and_the_memory_of_those_at_once(threads: int) -> None:
    plain, undistorting = Load(5_000, 0), Load(5_000, 0, undistorting=threads)
    more_mb, more_min = (ask("export_model", undistorting) - ask("export_model", plain) for ask in ASKING)
    # an image of 24 megapixels takes twice 72 MB, and took one thread 3.2 s
    assert 3 * 72 * threads < more_mb < 10 * 72 * threads
    assert 1.5 * 3.2 < 60 * more_min * threads / 5_000 < 3 * 3.2


def test_the_page_on_clusters_names_what_undistorted_images_ask_for(root: Path) -> None:
    page = " ".join((root / "docs" / "cluster.md").read_text().split())
    assert f"requests {UNDISTORTING_THREADS} threads, and per thread another {UNDISTORTED_MB} MB" in page
    assert f"requests another {UNDISTORTED_S:g} s per image, divided by the threads" in page
