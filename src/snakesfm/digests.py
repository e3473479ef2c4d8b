"""Digests that identify the configuration of a file, and unchanged inputs."""

import functools
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from snakesfm.given_files import find_cameras_file, list_model_files

# where things are, and what only the controller reads
UNTOLD = frozenset(
    (
        "images",
        "images_target",
        "cameras",
        "masks",
        "pairs_file",
        "reference",
        "imported",
        "weights",
        "fetch",
        "weights_content",
    )
)


def options_digest(stage_version: int, options: str) -> str:
    """A digest of a stage's version and the canonical JSON of its options: 16 hexadecimal digits."""
    return hashlib.sha256(f"{stage_version}\0{options}".encode()).hexdigest()[:16]


def result_digest(options: Any, beside: str, *contents: str) -> str:
    """SHA-256 of all that the cached result of an image or a pair depends on.

    Parameters
    ----------
    options : the stage's.
    beside : what counts beside them, such as a digest of weights.
    contents : digests of what was worked on.
    """
    text = "\0".join((*contents, options.canonical_json(), str(options.stage_version), beside))
    return hashlib.sha256(text.encode()).hexdigest()


def settings_text(settings: Mapping[str, Any], seed: int) -> str:
    """Canonical JSON of a job's seed and settings, but for where things are: the same in any folder."""
    told = {name: value for name, value in settings.items() if name not in UNTOLD}
    return json.dumps(told | {"seed": seed}, sort_keys=True)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's content, which is read in chunks, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@functools.cache
def file_digest(path: str, *beside: str) -> str:
    """SHA-256 of a file's name and content, or of the known cameras in a folder; '' for no path.

    Parameters
    ----------
    path : the file or folder.
    beside : names of files that count as well where they lie beside the file.
    """
    file = find_cameras_file(Path(path).expanduser()) if path else None
    if file is None:
        return ""
    return _digest([file, *(other for name in beside if (other := file.with_name(name)).is_file())])


@functools.cache
def model_digest(folder: str) -> str:
    """SHA-256 of the names and contents of the COLMAP model that a folder holds; '' for no path."""
    return _digest(list_model_files(Path(folder).expanduser())) if folder else ""


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + b"\0")
        with path.open("rb") as file:
            hashlib.file_digest(file, lambda: digest)
    return digest.hexdigest()


def file_state(path: Path) -> str:
    """Size and time of change of a file too large to be read while planning; '' where it is missing."""
    try:
        state = path.stat()
    except OSError:
        return ""
    return f"{state.st_size} {state.st_mtime_ns}"
