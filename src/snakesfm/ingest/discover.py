"""Which image files a folder holds, and whether their content changed.

The Snakefile asks this while it is parsed, so only light modules of the standard library are imported.
"""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path, PurePosixPath

from snakesfm.atomic import atomic_path
from snakesfm.digests import sha256_of
from snakesfm.errors import ConfigError

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
# photographs as telephones and cameras write them, which COLMAP and the tools after it do not read either
UNREAD_SUFFIXES = (
    *(".avif", ".heic", ".heif", ".jxl"),
    *(".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2"),
)
VIDEO_SUFFIXES = (".avi", ".mkv", ".mov", ".mp4")
DIGESTS_NAME = "digests.json"
MASK_DIGESTS_NAME = "mask_digests.json"
CACHE_VERSION = 2
# a file that was written so shortly before may change again within one tick of the file system's clock
SETTLED_NS = 2_000_000_000

Stamp = tuple[int, int, int]
"""Size, and times of change of the content and of the file: tools that edit EXIF can keep the first two."""


def walk_images(folder: Path | str) -> Iterator[str]:
    """The same as :func:`list_images`, one by one and in no order."""
    return _walk(Path(folder), "", frozenset(), SUFFIXES)


def list_images(folder: Path | str) -> list[str]:
    """The image files of a folder at any depth.

    Files and folders whose name starts with a dot are skipped, and folders whose name starts with @, where
    network drives keep thumbnails. Symbolic links are followed, but not back into a folder that holds the
    link. A link that leads nowhere is listed too: its user should hear of it.

    Returns
    -------
    POSIX paths relative to ``folder``, sorted.

    Raises
    ------
    ConfigError : the folder, or one inside it, cannot be listed.
    """
    return sorted(walk_images(folder))


def list_photographs(folder: Path | str) -> tuple[list[str], list[str]]:
    """What :func:`list_images` gives, and photographs of formats that are not read, in one walk.

    Of the latter those are left out that have an image of the same name beside them.
    """
    names = sorted(_walk(Path(folder), "", frozenset(), SUFFIXES + UNREAD_SUFFIXES))
    images = [name for name in names if name.lower().endswith(SUFFIXES)]
    read = {PurePosixPath(name).with_suffix("") for name in images}
    others = [name for name in names if name.lower().endswith(UNREAD_SUFFIXES)]
    return images, [name for name in others if PurePosixPath(name).with_suffix("") not in read]


def list_videos(folder: Path | str) -> list[str]:
    """The video files of a folder at any depth, as :func:`list_images` lists images."""
    return sorted(_walk(Path(folder), "", frozenset(), VIDEO_SUFFIXES))


def count_images(folder: Path | str, limit: int | None = None) -> int:
    """Number of image files of a folder at any depth, counted up to ``limit`` where one is given.

    Raises
    ------
    ConfigError : the folder, or one inside it, cannot be listed.
    """
    return sum(1 for _ in islice(walk_images(folder), limit))


def resolved_name(folder: Path) -> str:
    """A folder's absolute path without links, for an artifact: what is no UTF-8 is escaped."""
    return str(folder.resolve()).encode("utf-8", "backslashreplace").decode()


def fingerprint_images(folder: Path | str, cache_file: Path | str | None = None) -> str:
    """Digest of the names and contents of all image files of a folder.

    A file that was touched but not changed gives the same digest.

    Raises
    ------
    ConfigError : the folder, or one inside it, cannot be listed.
    """
    return fingerprint(digest_images(folder, list_images(folder), cache_file))


def fingerprint(digests: Mapping[str, str]) -> str:
    """Digest of the names of files and of their digests, in this order."""
    whole = hashlib.sha256()
    for name, digest in digests.items():
        whole.update(os.fsencode(name) + b"\0" + digest.encode() + b"\n")
    return whole.hexdigest()


def digest_images(
    folder: Path | str,
    names: Sequence[str],
    cache_file: Path | str | None = None,
    threads: int | None = None,
) -> dict[str, str]:
    """SHA-256 of every file, hexadecimal; empty for a file that cannot be read.

    Parameters
    ----------
    folder : image folder.
    names : paths relative to it.
    cache_file : JSON file that remembers digests with size and times of change, so that an unchanged file
        is not read again; it is made where it can be, and ignored where it cannot be read or written.
    threads : how many files are read at once; None for as many as there are cores, at most 8.
    """
    root = Path(folder).resolve()
    known = _read_cache(cache_file, str(root))
    stamps = {name: _stamp(root / name) for name in names}
    digests: dict[str, str] = {}
    for name, stamp in stamps.items():
        if stamp is None:
            digests[name] = ""
        elif known.get(name, ((), ""))[0] == stamp:
            digests[name] = known[name][1]
    missing = [name for name in names if name not in digests]
    digests |= dict(zip(missing, _digest_files([root / n for n in missing], threads), strict=True))
    # the time of the content may be any, that of the file is the clock's at each change
    newest = time.time_ns() - SETTLED_NS
    kept = {
        name: (stamp, digests[name])
        for name, stamp in stamps.items()
        if stamp is not None and stamp[2] < newest and digests[name]
    }
    if cache_file is not None and kept != known:
        _write_cache(Path(cache_file), str(root), kept)
    return {name: digests[name] for name in names}


def _walk(
    folder: Path, prefix: str, above: frozenset[tuple[int, int]], suffixes: tuple[str, ...]
) -> Iterator[str]:
    try:
        status = folder.stat()
        with os.scandir(folder) as listing:
            entries = list(listing)
    except OSError as error:
        raise ConfigError(
            f"The image folder '{folder}' cannot be listed ({error.strerror}): "
            "correct its path or its permissions."
        ) from None
    above |= {(status.st_dev, status.st_ino)}
    for entry in entries:
        if entry.name.startswith("."):
            continue
        if _is(entry, "is_dir"):
            if entry.name.startswith("@"):
                continue
            target = entry.stat()
            if (target.st_dev, target.st_ino) not in above:
                yield from _walk(Path(entry.path), f"{prefix}{entry.name}/", above, suffixes)
        elif entry.name.lower().endswith(suffixes) and (
            _is(entry, "is_file") or (entry.is_symlink() and not Path(entry.path).exists())
        ):
            yield prefix + entry.name


def _is(entry: "os.DirEntry[str]", question: str) -> bool:
    try:
        return bool(getattr(entry, question)())
    except OSError:
        return False


def _stamp(path: Path) -> Stamp | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _digest_files(paths: list[Path], threads: int | None) -> list[str]:
    workers = min(len(paths), threads or min(8, os.cpu_count() or 1))
    if workers <= 1:
        return [_digest_file(path) for path in paths]
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(_digest_file, paths))


def _digest_file(path: Path) -> str:
    try:
        return sha256_of(path)
    except OSError:
        return ""


def _read_cache(cache_file: Path | str | None, root: str) -> dict[str, tuple[Stamp, str]]:
    if cache_file is None:
        return {}
    try:
        content = json.loads(Path(cache_file).read_text("utf-8"))
        if content["version"] != CACHE_VERSION or content["folder"] != root:
            return {}
        return {
            str(name): ((int(size), int(changed_ns), int(touched_ns)), str(digest))
            for name, (size, changed_ns, touched_ns, digest) in content["files"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _write_cache(cache_file: Path, root: str, known: dict[str, tuple[Stamp, str]]) -> None:
    content = {
        "version": CACHE_VERSION,
        "folder": root,
        "files": {name: (*stamp, digest) for name, (stamp, digest) in known.items()},
    }
    # without the cache everything still works, only slower
    with contextlib.suppress(OSError), atomic_path(cache_file) as temporary:
        temporary.write_text(json.dumps(content, separators=(",", ":")), "utf-8")
