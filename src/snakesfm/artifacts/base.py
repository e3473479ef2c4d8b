"""Declaration, writing, reading and checking of artifacts.

An artifact is a frozen dataclass whose fields are declared with :func:`column`. One HDF5 file holds
one artifact: a dataset per column, and root attributes that say what it is. A file is written to a
temporary name in the same folder and renamed, so a file that is there is complete.
"""

import dataclasses
import json
import os
import re
import shutil
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import h5py
import numpy as np

import snakesfm
from snakesfm.arrays import Array
from snakesfm.atomic import atomic_path
from snakesfm.errors import LASTING, ArtifactError, UnreadableArtifactError, remedy_of

TEMPORARY = ".export."
STRING = h5py.string_dtype("utf-8")


@dataclass(frozen=True)
class Header:
    """Where an artifact comes from; the root attributes of its file.

    ``images`` is the image folder, of the index alone: no reader compares it, as no result depends on it.
    """

    stage: str
    stage_version: int
    scene: str
    options: str = "{}"
    settings: str = ""
    images: str = ""


def column(shape: str, dtype: str, description: str) -> Any:
    """Declare a column.

    Parameters
    ----------
    shape : symbolic shape such as ``"(P,2)"``; a letter must have one length in the whole artifact and
        ``P+1`` is one more than ``P``.
    dtype : numpy dtype name, several joined by ``|`` where the array's own is kept, or ``"str"``.
    description : one sentence with unit and frame, for docs/artifacts.md.
    """
    return dataclasses.field(metadata={"shape": shape, "dtype": dtype, "description": description})


def _dimensions(shape: str) -> list[str]:
    return [part.strip() for part in shape.strip("()").split(",") if part.strip()]


@dataclass(frozen=True)
class Artifact:
    """Base of all artifacts: write, read, and checks of dtype and shape."""

    kind: ClassVar[str] = ""
    format_version: ClassVar[int] = 1

    def __post_init__(self) -> None:
        lengths: dict[str, int] = {}
        for field in dataclasses.fields(self):
            value = self._coerce(field)
            object.__setattr__(self, field.name, value)
            self._check_shape(field, value, lengths)

    def _coerce(self, field: "dataclasses.Field[Any]") -> Array:
        value = getattr(self, field.name)
        dtype = field.metadata["dtype"]
        if dtype == "str":
            return np.asarray([str(item) for item in value], dtype=object)
        array = np.asarray(value)
        if "|" in dtype:
            if array.dtype.name not in dtype.split("|"):
                raise ValueError(f"{self.kind}.{field.name} is {array.dtype}, expected {dtype}")
            dtype = array.dtype.name
        if array.size and not np.can_cast(array.dtype, dtype, casting="same_kind"):
            raise ValueError(f"{self.kind}.{field.name} is {array.dtype}, expected {dtype}")
        array = np.ascontiguousarray(array, dtype=dtype)
        dims = _dimensions(field.metadata["shape"])
        if array.size == 0 and array.ndim != len(dims):
            array = array.reshape([int(d) if d.isdigit() else 0 for d in dims])
        return array

    def _check_shape(self, field: "dataclasses.Field[Any]", value: Array, lengths: dict[str, int]) -> None:
        dims = _dimensions(field.metadata["shape"])
        if value.ndim != len(dims):
            raise ValueError(
                f"{self.kind}.{field.name} has shape {value.shape}, not {field.metadata['shape']}"
            )
        for dim, actual in zip(dims, value.shape, strict=True):
            name, _, more = dim.partition("+")
            length = actual - int(more or 0)
            expected = int(name) if name.isdigit() else lengths.setdefault(name, length)
            if length != expected:
                raise ValueError(
                    f"{self.kind}.{field.name} has shape {value.shape}, "
                    f"not {field.metadata['shape']} with {name}={expected}"
                )

    def write(self, path: Path | str, header: Header) -> None:
        """Write the artifact to ``path``, complete or not at all."""
        with atomic_path(Path(path)) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["artifact"] = self.kind
            file.attrs["format_version"] = self.format_version
            file.attrs["stage"] = header.stage
            file.attrs["stage_version"] = header.stage_version
            file.attrs["scene"] = header.scene
            file.attrs["options"] = header.options
            file.attrs["settings"] = header.settings
            if header.images:
                file.attrs["images"] = header.images
            file.attrs["software"] = f"snakesfm {snakesfm.__version__}"
            file.attrs["checksum"] = checksum(
                getattr(self, field.name) for field in dataclasses.fields(self)
            )
            for field in dataclasses.fields(self):
                value = getattr(self, field.name)
                if field.metadata["dtype"] == "str":
                    file.create_dataset(field.name, data=value, dtype=STRING)
                else:
                    file.create_dataset(field.name, data=value)

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read an artifact.

        Raises
        ------
        ArtifactError : the file is missing, damaged, of another kind or of another version, or cannot be
            read now.
        """
        with cls.open(path) as file:
            try:
                made = file.attrs.get("checksum")
                values = {field.name: _read_column(file, field) for field in dataclasses.fields(cls)}
                if made is None or made == checksum(values.values()):
                    return cls(**values)
            # what h5py raises on damage has no common kind
            except (KeyError, OSError, RuntimeError, ValueError, TypeError) as error:
                _refuse_unreadable(path, error)
        raise ArtifactError(f"{path} is damaged: delete it and run snakemake again.")

    @classmethod
    def read_former(cls, path: Path | None) -> Self | None:
        """Read an earlier version of a stage's output; None where there is none, or it is damaged.

        Raises
        ------
        UnreadableArtifactError : the system cannot read it now.
        """
        try:
            return cls.read(path) if path is not None else None
        except UnreadableArtifactError:
            raise
        except ArtifactError:
            return None

    @classmethod
    def open(cls, path: Path | str) -> h5py.File:
        """Open an artifact's file for reading after checking its kind and version.

        Raises
        ------
        ArtifactError : the file is missing, damaged, of another kind or of another version, or cannot be
            read now.
        """
        file = None
        try:
            file = h5py.File(path, "r", locking=False)
            kind, version = file.attrs.get("artifact"), file.attrs.get("format_version")
        except FileNotFoundError:
            raise ArtifactError(f"{path} is missing: run snakemake again to make it.") from None
        # what h5py raises on damage has no common kind
        except Exception as error:
            if file is not None:
                file.close()
            _refuse_unreadable(path, error)
            raise ArtifactError(
                f"{path} is damaged or not an HDF5 file: delete it and run snakemake again."
            ) from None
        if kind != cls.kind or version != cls.format_version:
            file.close()
            raise ArtifactError(
                f"{path} holds '{kind}' version {version}, but '{cls.kind}' version "
                f"{cls.format_version} is needed: delete it and run snakemake again."
            )
        return file


def _read_column(file: h5py.File, field: "dataclasses.Field[Any]") -> Array:
    dataset = file[field.name]
    return np.asarray(dataset.asstr()[()] if field.metadata["dtype"] == "str" else dataset[()])


def checksum(columns: Iterable[Array]) -> int:
    """CRC-32 of the content of arrays, strings among them, to tell damage by."""
    total = 0
    for column in columns:
        if column.dtype == object:
            total = zlib.crc32("\0".join(column.ravel()).encode(), total)
        else:
            total = zlib.crc32(np.ascontiguousarray(column).reshape(-1).view(np.uint8).data, total)
    return total


def read_header(path: Path | str) -> Mapping[str, Any]:
    """The root attributes of an artifact's file; empty where it is missing or damaged.

    Raises
    ------
    UnreadableArtifactError : the system cannot read it now.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            header = dict(file.attrs)
        # text with bytes that are no UTF-8 can be neither digested nor printed
        "".join(map(str, header.values())).encode()
    except Exception as error:
        _refuse_unreadable(path, error)
        return {}
    return header


def _refuse_unreadable(path: Path | str, error: Exception) -> None:
    """Raise where the system failed to read a file, as for a moment on one node: it may be healthy.

    HDF5 then gives the system's number, with some errors in their text alone, and with none of a file that
    is damaged.
    """
    found = re.search(r"\berrno = (\d+)", str(error))
    number = int(found[1]) if found else getattr(error, "errno", None)
    if number and number not in LASTING:
        reason = os.strerror(number)
        raise UnreadableArtifactError(
            f"{path} cannot be read now ({reason}): {remedy_of(number)}."
        ) from None


@contextmanager
def temporary_folder(folder: Path) -> Iterator[Path]:
    """Context manager: yields a temporary folder within ``folder``, from which files are to be renamed.

    What writers that were killed left there is removed, so there is one writer at a time.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f"{TEMPORARY}*"):
        shutil.rmtree(leftover)
    with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=folder) as name:
        yield Path(name)


def write_json(path: Path, content: Any) -> None:
    """Write JSON with sorted keys, complete or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", "utf-8")
