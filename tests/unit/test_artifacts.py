"""Artifacts: round trips, checks of shape and dtype, and damaged files."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesfm.artifacts import (
    ARTIFACTS,
    Artifact,
    Header,
    ImagePairs,
    LocalFeatures,
    PairMatches,
    ViewGraph,
)
from snakesfm.atomic import atomic_path
from snakesfm.errors import ArtifactError

HEADER = Header("match_pairs", 3, "castle", '{"ratio": 0.8}')


def example(cls: type[Artifact], lengths: dict[str, int]) -> Artifact:
    """An artifact with random content of the given lengths."""
    rng = np.random.default_rng(7)
    values = {}
    for field in dataclasses.fields(cls):
        shape = []
        for dim in field.metadata["shape"].strip("()").split(","):
            name, _, more = dim.strip().partition("+")
            shape.append(int(name) if name.isdigit() else lengths.get(name, 3) + int(more or 0))
        # of several dtypes, whichever: all are kept as they are
        dtype = field.metadata["dtype"].split("|")[-1]
        if dtype == "str":
            values[field.name] = [f"näme {{{k}}} #{k}.JPG" for k in range(shape[0])]
        elif dtype == "bool":
            values[field.name] = rng.random(shape) < 0.5
        elif dtype.startswith("float"):
            values[field.name] = rng.normal(size=shape).astype(dtype)
        else:
            values[field.name] = rng.integers(0, 100, shape).astype(dtype)
    return cls(**values)


@pytest.mark.parametrize("cls", ARTIFACTS, ids=lambda c: c.kind)
@pytest.mark.parametrize("length", [0, 1, 5])
def test_round_trip_is_exact_and_bytes_repeat(cls: type[Artifact], length: int, tmp_path: Path) -> None:
    names = {d for f in dataclasses.fields(cls) for d in f.metadata["shape"] if d.isalpha()}
    original = example(cls, dict.fromkeys(names, length))
    original.write(tmp_path / "a.h5", HEADER)
    original.write(tmp_path / "b.h5", HEADER)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    back = cls.read(tmp_path / "a.h5")
    for field in dataclasses.fields(cls):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(original, field.name))
        assert getattr(back, field.name).dtype == getattr(original, field.name).dtype


@pytest.mark.parametrize("cls", ARTIFACTS, ids=lambda c: c.kind)
def test_every_column_says_shape_type_and_meaning(cls: type[Artifact]) -> None:
    for field in dataclasses.fields(cls):
        assert field.metadata["shape"].startswith("(")
        assert len(field.metadata["description"]) > 10


def test_header_is_in_the_root_attributes(tmp_path: Path) -> None:
    ImagePairs(pairs=[], reasons=[], similarities=[], likenesses=[]).write(tmp_path / "a.h5", HEADER)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file.attrs["artifact"] == "image_pairs"
        assert file.attrs["stage"] == "match_pairs"
        assert file.attrs["stage_version"] == 3
        assert file.attrs["scene"] == "castle"
        assert file.attrs["options"] == '{"ratio": 0.8}'


def test_lengths_that_disagree_are_refused() -> None:
    with pytest.raises(ValueError, match="reasons"):
        ImagePairs(pairs=[[0, 1]], reasons=[], similarities=[0.0], likenesses=[0.0])
    with pytest.raises(ValueError, match="offsets"):
        PairMatches(pairs=[[0, 1]], digests=["x"], offsets=[0], matches=[], scores=[])


def test_a_dtype_that_would_lose_information_is_refused() -> None:
    with pytest.raises(ValueError, match="pairs"):
        ImagePairs(pairs=[[0.5, 1.5]], reasons=["x"], similarities=[0.0], likenesses=[0.0])


@pytest.mark.parametrize("keep", [0, 10, 700])
def test_a_truncated_file_gives_one_sentence(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "a.h5"
    ImagePairs(pairs=[[0, 1]], reasons=["x"], similarities=[0.5], likenesses=[0.5]).write(path, HEADER)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ArtifactError, match="damaged") as caught:
        ImagePairs.read(path)
    assert str(path) in str(caught.value)


def test_another_kind_another_version_and_no_file_give_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with pytest.raises(ArtifactError, match="missing"):
        ImagePairs.read(path)
    ImagePairs(pairs=[], reasons=[], similarities=[], likenesses=[]).write(path, HEADER)
    with pytest.raises(ArtifactError, match="view_graph"):
        ViewGraph.read(path)
    with h5py.File(path, "a") as file:
        file.attrs["format_version"] = 99
    with pytest.raises(ArtifactError, match="99"):
        ImagePairs.read(path)


def test_a_failing_writer_leaves_the_old_file_and_no_rest(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_removed_and_a_living_one_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    dead = tmp_path / f".a.h5.{os.uname().nodename}.{child.pid}.x.tmp"
    living = tmp_path / f".a.h5.{os.uname().nodename}.{os.getpid()}.x.tmp"
    elsewhere, abandoned = (tmp_path / f".a.h5.other-host.{child.pid}.{name}.tmp" for name in "xy")
    for leftover in (dead, living, elsewhere, abandoned):
        leftover.write_text("half")
    now = dead.stat().st_mtime
    for leftover, days in ((living, 8), (elsewhere, 6), (abandoned, 8)):
        os.utime(leftover, (now, now - days * 86_400))
    ImagePairs(pairs=[], reasons=[], similarities=[], likenesses=[]).write(path, HEADER)
    assert sorted(tmp_path.iterdir()) == sorted([living, elsewhere, path])


@settings(max_examples=25)
@given(
    st.lists(
        st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]), min_size=1, max_size=12), max_size=5
    )
)
def test_any_text_survives(tmp_path_factory: pytest.TempPathFactory, texts: list[str]) -> None:
    path = tmp_path_factory.mktemp("text") / "a.h5"
    pairs = np.zeros((len(texts), 2), dtype=np.int32)
    ImagePairs(
        pairs=pairs, reasons=texts, similarities=np.zeros(len(texts)), likenesses=np.zeros(len(texts))
    ).write(path, HEADER)
    assert list(ImagePairs.read(path).reasons) == texts


@pytest.mark.parametrize("dtype", ["uint8", "float16", "float32"])
def test_descriptors_keep_their_dtype(tmp_path: Path, dtype: str) -> None:
    made = dataclasses.replace(example(LocalFeatures, {}), descriptors=np.ones((3, 8), dtype))
    made.write(tmp_path / "features.h5", HEADER)
    assert LocalFeatures.read(tmp_path / "features.h5").descriptors.dtype == dtype


def test_descriptors_of_another_dtype_are_refused() -> None:
    with pytest.raises(ValueError, match=r"descriptors is int64, expected uint8\|float16\|float32"):
        dataclasses.replace(example(LocalFeatures, {}), descriptors=np.ones((3, 8), np.int64))
