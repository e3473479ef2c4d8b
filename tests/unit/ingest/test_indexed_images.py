"""Images that cannot be read now, or are others than when they were indexed, are not taken for damaged ones."""

import io
import resource
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from plain_artifacts import write_plain_index

from snakesfm.artifacts import ImageIndex, LocalFeatures
from snakesfm.config.adjust_bundle import AdjustBundleOptions
from snakesfm.config.extract_features import ExtractFeaturesOptions
from snakesfm.config.index_images import IndexImagesOptions
from snakesfm.config.match_pairs import MatchPairsOptions
from snakesfm.errors import SceneError
from snakesfm.ingest.discover import digest_images
from snakesfm.ingest.indexed import IndexedImages
from snakesfm.stages import extract_features, index_images, match_pairs, merge_keypoints
from snakesfm.stages.adjust_bundle import _image_sources
from snakesfm.stages.job import StageJob

NAMES = ["a.jpg", "b.png", "c.tif"]
SIZE = (320, 240)
MB = 1 << 20


def draw(path, seed, size=SIZE):
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)
    cv2.imwrite(str(path), cv2.resize(small, size, interpolation=cv2.INTER_CUBIC))


@pytest.fixture
def images(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for seed, name in enumerate(NAMES):
        draw(folder / name, seed)
    return folder


def index_of(images):
    sha256 = list(digest_images(images, NAMES).values())
    write_plain_index(images.parent / "index.h5", NAMES, [SIZE] * len(NAMES), sha256=sha256)
    return IndexedImages(np.array(NAMES), np.array(sha256), images)


def job_of(stage, images, options):
    inputs = {"index": images.parent / "index.h5"}
    settings = {"images": str(images), "block": 0}
    return StageJob(stage, "scene", inputs, (images.parent / f"{stage}.h5",), options, settings)


def hide(path):
    path.rename(path.with_name("hidden"))


def forbid(path):
    """A file that even root cannot read: a folder stands for it."""
    path.unlink()
    path.mkdir()


def turn_around(path):
    path.unlink()
    path.symlink_to(path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("fault", [hide, forbid, turn_around])
def test_a_file_that_cannot_be_read_now_ends_the_job(images, name, fault):
    reader = index_of(images)
    assert reader.read(NAMES.index(name)).gray.shape == SIZE[::-1]
    fault(images / name)
    with pytest.raises(SceneError, match=rf"{name} could not be read .*: start the same command again"):
        reader.read(NAMES.index(name))


@pytest.mark.parametrize("name", NAMES)
def test_other_content_than_was_indexed_ends_the_job(images, name):
    reader = index_of(images)
    draw(images / name, 9)
    with pytest.raises(SceneError, match=rf"{name} was changed after .*: start the same command again"):
        reader.read(NAMES.index(name))
    (images / name).write_bytes(b"")
    with pytest.raises(SceneError, match="was changed"):
        reader.read(NAMES.index(name))


def test_a_lost_image_leaves_no_features_and_the_next_run_finds_them(images):
    index_of(images)
    job = job_of("extract_features", images, ExtractFeaturesOptions(max_keypoints=200))
    hide(images / "b.png")
    with pytest.raises(SceneError, match=r"b\.png"):
        extract_features.run(job)
    assert not job.output.exists()
    (images / "hidden").rename(images / "b.png")
    extract_features.run(job)
    counts = np.diff(LocalFeatures.read(job.output).offsets)
    assert (counts > 50).all() and (counts <= 200).all()


@pytest.mark.parametrize("stage", ["match_pairs", "merge_keypoints", "adjust_bundle"])
def test_no_stage_takes_a_lost_image_for_a_damaged_one(images, stage):
    reader = index_of(images)
    hide(images / "a.jpg")
    with pytest.raises(SceneError, match=r"a\.jpg could not be read"):
        if stage == "match_pairs":
            match_pairs.ImageFiles(job_of(stage, images, MatchPairsOptions(method="loftr"))).read(0)
        elif stage == "merge_keypoints":
            merge_keypoints._read_colors(reader, 0, np.ones((1, 2), np.float32))
        else:
            job = job_of(stage, images, AdjustBundleOptions())
            _image_sources(job, ImageIndex.read(job.path("index")))[0].read_gray(0)


def test_a_damaged_image_is_left_out_and_the_terminal_says_so(images, capsys):
    damaged = bytearray((images / "b.png").read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 64] = bytes(64)
    (images / "b.png").write_bytes(damaged)
    index_of(images)
    terminal = io.StringIO()
    job = job_of("extract_features", images, ExtractFeaturesOptions(max_keypoints=200))
    extract_features.run(replace(job, terminal=terminal))
    counts = np.diff(LocalFeatures.read(job.output).offsets)
    assert counts[1] == 0 and min(counts[0], counts[2]) > 50
    assert "b.png is damaged" in capsys.readouterr().out
    assert (
        "warning: 1 of 3 images have no keypoints" in terminal.getvalue() and "b.png" in terminal.getvalue()
    )
    matched = match_pairs.ImageFiles(job_of("match_pairs", images, MatchPairsOptions(method="loftr")))
    assert not matched.read(1).gray.any() and matched.read(0).gray.any()
    assert list(matched.images.damaged) == [1] and "b.png is damaged" in matched.images.damaged[1]


CODE = f"""
import resource, sys
from pathlib import Path
from snakesfm.ingest.read import read_image
read_image(Path(sys.argv[1]).with_name("small.png"))
with open("/proc/self/statm") as file:
    used = int(file.read().split()[0]) * {resource.getpagesize()}
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[2]), -1))
try:
    read_image(sys.argv[1])
except MemoryError:
    print("no memory")
"""


@pytest.mark.parametrize("name", ["large.png", "large.jpg", "large.tif"])
def test_too_little_memory_is_no_damage(tmp_path, name):
    draw(tmp_path / "small.png", 0)
    draw(tmp_path / name, 0, (8000, 6000))
    said = []
    for room in (10 * MB, 200 * MB):
        command = [sys.executable, "-c", CODE, str(tmp_path / name), str(room)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said.append(done.stdout.strip())
        assert done.returncode == 0, done.stderr
    assert said == ["no memory"] * 2


def test_an_image_that_can_be_read_one_time_of_two_is_not_refused_for_good(images, tmp_path):
    """As where a disk fails for a moment: its digest is remembered, but it cannot be read."""
    output = tmp_path / "index_images" / "index.h5"
    settings = {"images": str(images), "cameras": "", "blocks": 1}
    job = StageJob("index_images", "scene", {}, (output,), IndexImagesOptions(), settings)
    digests = digest_images(images, NAMES)
    hide(images / "b.png")
    with pytest.raises(SceneError, match=r"b\.png could be read at one moment and not at another"):
        index_images._read_headers(job, images, digests)
    assert index_images._read_headers(job, images, digests | {"b.png": ""})[1].keys() == {"b.png"}
    (images / "hidden").rename(images / "b.png")
    assert len(index_images._read_headers(job, images, digests)[0]) == len(NAMES)
    with pytest.raises(SceneError, match=r"b\.png could be read at one moment and not at another"):
        index_images._read_headers(job, images, digests | {"b.png": ""})
