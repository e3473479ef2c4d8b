"""Files that a job must not read: they are set aside with one sentence."""

import os
import resource
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from snakesfm.artifacts import Header, ImagePairs, base, checks
from snakesfm.artifacts.checks import check_content, check_inputs, set_aside
from snakesfm.digests import options_digest
from snakesfm.errors import ArtifactError, UnreadableArtifactError

DIGESTS = {"select_pairs": options_digest(3, '{"a": 1}')}


def write_pairs(
    path: Path,
    stage: str = "select_pairs",
    version: int = 3,
    scene: str = "s",
    options: str = '{"a": 1}',
    settings: str = "",
) -> Path:
    pairs = ImagePairs(
        pairs=np.array([[0, 1]]),
        reasons=np.array(["listed"], object),
        similarities=np.array([0.5]),
        likenesses=np.array([2.0]),
    )
    pairs.write(path, Header(stage, version, scene, options, settings))
    return path


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-300])


def flip_byte(before: bytes, count: int) -> Callable[[Path], None]:
    """Damage a file in one byte, so far after the first place of others."""

    def damage(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[content.index(before) + count] ^= 0xFF
        path.write_bytes(content)

    return damage


def test_a_file_of_this_scene_and_configuration_is_left_alone(tmp_path: Path) -> None:
    path = write_pairs(tmp_path / "0-0.h5")
    before = path.read_bytes()
    check_inputs([path, tmp_path / "missing.h5", tmp_path / "other.json"], "s", DIGESTS)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (truncate, "is damaged"),
        (lambda path: path.write_bytes(b""), "is damaged"),
        (lambda path: path.write_bytes(b"\0" * 5000), "is damaged"),
        # an attribute's type, and a text that is no UTF-8 then
        (flip_byte(b"stage\0", -4), "is damaged"),
        (flip_byte(b'{"a": 1}', 0), "is damaged"),
        (lambda path: write_pairs(path, version=2), "another version"),
        (lambda path: write_pairs(path, options='{"a": 2}'), "other options"),
        (lambda path: write_pairs(path, scene="t"), "is of scene 't'"),
        (lambda path: write_pairs(path, stage="match_pairs"), "is of stage 'match_pairs'"),
    ],
)
def test_any_other_file_is_set_aside(tmp_path: Path, damage: Callable[[Path], None], reason: str) -> None:
    good, bad = write_pairs(tmp_path / "0-0.h5"), write_pairs(tmp_path / "0-1.h5")
    damage(bad)
    content = bad.read_bytes()
    with pytest.raises(ArtifactError, match=reason) as caught:
        check_inputs([good, bad], "s", DIGESTS)
    assert str(bad) in str(caught.value)
    assert "start the same command again" in str(caught.value)
    assert good.is_file()
    assert not bad.exists()
    assert (tmp_path / "0-1.h5.refused").read_bytes() == content


def test_one_sentence_for_several_files(tmp_path: Path) -> None:
    first = write_pairs(tmp_path / "0-0.h5", scene="t")
    second = tmp_path / "0-1.h5"
    shutil.copy(first, second)
    with pytest.raises(ArtifactError, match="and 1 more"):
        check_inputs([first, second], "s", DIGESTS)
    assert not first.exists()
    assert not second.exists()


def test_a_file_with_damaged_attributes_is_not_read(tmp_path: Path) -> None:
    path = write_pairs(tmp_path / "0-0.h5")
    # the heap that holds all texts
    flip_byte(b"GCOL", 0)(path)
    assert ImagePairs.read_former(path) is None
    with pytest.raises(ArtifactError, match="is damaged or not an HDF5 file: delete it"):
        ImagePairs.read(path)


@pytest.mark.parametrize(
    ("made", "wanted", "kept"), [("a", "a", True), ("a", "b", False), ("", "b", True), ("a", "", True)]
)
def test_files_of_other_settings_are_set_aside_unless_they_are_not_told(
    tmp_path: Path, made: str, wanted: str, kept: bool
) -> None:
    path = write_pairs(tmp_path / "0-0.h5", settings=made)
    refused = set_aside([path], "s", DIGESTS, lambda stage, file: wanted if file == path else "")
    assert path.is_file() == kept
    assert len(refused) == 1 - kept
    assert kept or "another seed" in refused[0]


def test_damage_inside_a_file_is_found_and_nothing_else_touched(tmp_path: Path) -> None:
    good, bad = write_pairs(tmp_path / "0-0.h5"), write_pairs(tmp_path / "0-1.h5")
    other = tmp_path / "features.h5"
    with h5py.File(other, "w") as file:
        file["x"] = [1.0]
    check_content([good, bad, other, tmp_path / "missing.h5", tmp_path / "x.json"])
    with h5py.File(bad, "r+") as file:
        file["likenesses"][0] = 3.0
    with pytest.raises(ArtifactError, match="is damaged") as caught:
        check_content([good, bad, other])
    assert str(bad) in str(caught.value)
    assert not bad.exists()
    assert good.is_file()
    assert other.is_file()


@contextmanager
def no_more_files() -> Iterator[None]:
    """Have the system open no further file for this process."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_file_that_cannot_be_read_for_a_moment_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign, good = write_pairs(tmp_path / "0-0.h5", scene="t"), write_pairs(tmp_path / "0-1.h5")
    for check in (lambda: check_inputs([good], "s", DIGESTS), lambda: check_content([good])):
        with no_more_files(), pytest.raises(UnreadableArtifactError) as caught:
            check()
        assert str(caught.value) == (
            f"{good} cannot be read now (Too many open files): start the same command again."
        )
    with no_more_files(), pytest.raises(UnreadableArtifactError):
        ImagePairs.read(good)
    check_inputs([good], "s", DIGESTS)

    def fail_one(path: Path) -> Mapping[str, Any]:
        if path == good:
            raise UnreadableArtifactError(path)
        return base.read_header(path)

    monkeypatch.setattr(checks, "read_header", fail_one)
    with pytest.raises(UnreadableArtifactError):
        check_inputs([foreign, good], "s", DIGESTS)
    assert sorted(tmp_path.iterdir()) == [foreign, good]


@pytest.mark.parametrize(
    "error",
    [
        OSError(5, "Can't synchronously read data (file read failed: errno = 5, error message = '...')"),
        # as h5py has it of a dataset that cannot be looked up
        KeyError("Unable to synchronously open object (file read failed: time = now\n, errno = 5, error)"),
    ],
)
def test_columns_that_cannot_be_read_for_a_moment_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    damaged, good = write_pairs(tmp_path / "0-0.h5"), write_pairs(tmp_path / "0-1.h5")
    truncate(damaged)

    def fail(file: h5py.File, field: object) -> None:
        raise error

    monkeypatch.setattr(base, "_read_column", fail)
    with pytest.raises(UnreadableArtifactError, match=rf"{good} cannot be read now \({os.strerror(5)}\)"):
        check_content([damaged, good])
    assert sorted(tmp_path.iterdir()) == [damaged, good]
    monkeypatch.undo()
    check_content([good])
