"""Digests that identify the configuration of a file, and unchanged inputs."""

import functools
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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


def settings_text(settings: Mapping[str, Any], seed: int) -> str:
    """Canonical JSON of a job's seed and settings, but for where things are: the same in any folder."""
    told = {name: value for name, value in settings.items() if name not in UNTOLD}
    return json.dumps(told | {"seed": seed}, sort_keys=True)


@functools.cache
def file_digest(path: str, *beside: str) -> str:
    """SHA-256 of a small file, or of the cameras, images and points files of a folder; '' for no path.

    Parameters
    ----------
    path : the file or folder.
    beside : names of files that count as well where they lie beside a file.
    """
    if not path:
        return ""
    root = Path(path).expanduser()
    if root.is_file():
        files = [root, *(other for name in beside if (other := root.with_name(name)).is_file())]
    else:
        files = sorted(p for p in root.rglob("*") if p.suffix in {".txt", ".bin"})
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def file_state(path: Path) -> str:
    """Size and time of change of a file too large to be read while planning; '' where it is missing."""
    try:
        state = path.stat()
    except OSError:
        return ""
    return f"{state.st_size} {state.st_mtime_ns}"
