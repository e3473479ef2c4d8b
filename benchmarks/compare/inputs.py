"""Digests of what measurements start from: what is stored is measured again where these differ."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from benchmarks import ROOT
from benchmarks.compare.sets import ImageSet

SOURCES = ("Snakefile", "config.yaml", "scripts", "workflow/rules", "src/snakesfm")


def inputs_of(image_set: ImageSet, *parts: object) -> str:
    """Digest of an image set, of whether its intrinsics are given, and of ``parts``."""
    return hashlib.sha256(repr((_content(image_set), image_set.known, *parts)).encode()).hexdigest()


def _content(image_set: ImageSet) -> str:
    """Digest of the names and bytes of the images and of the reference."""
    digest = hashlib.sha256()
    images = [image_set.images / name for name in image_set.image_names()]
    reference = sorted(path for path in image_set.reference.rglob("*") if path.is_file())
    for path in [*images, *reference]:
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").digest()
        digest.update(path.relative_to(image_set.folder).as_posix().encode() + b"\0" + content)
    return digest.hexdigest()


def source_digest() -> str:
    """Digest of all of snakesfm that decides what the workflow computes."""
    digest = hashlib.sha256()
    for file in _source_files():
        digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _source_files() -> Iterator[Path]:
    for name in SOURCES:
        path = ROOT / name
        yield from [path] if path.is_file() else sorted(path.rglob("*.py")) + sorted(path.rglob("*.smk"))
