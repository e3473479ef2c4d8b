"""Files that are there complete or not at all. Imports little, as the Snakefile and its jobs do."""

import os
import tempfile
from pathlib import Path

# a writer on another machine cannot be asked whether it lives, and changes its file in all that time
ABANDONED_S = 7 * 86_400


class atomic_path:  # noqa: N801 - used as a function, like contextlib's
    """Context manager: yields a temporary path beside ``path`` and renames it on success.

    What writers that were killed on this machine left of the same file is removed, and what those on others
    left a week ago.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Path:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{self.path.name}.{os.uname().nodename}.{os.getpid()}.",
            suffix=".tmp",
            dir=self.path.parent,
        )
        # on the clock of the file system
        now = os.fstat(handle).st_mtime
        os.close(handle)
        self.temporary = Path(name)
        self.temporary.chmod(0o666 & ~_umask())
        _remove_leftovers(self.path, now)
        return self.temporary

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if kind is None:
            with self.temporary.open("rb+") as file:
                os.fsync(file.fileno())
            self.temporary.replace(self.path)
        else:
            self.temporary.unlink(missing_ok=True)


def _remove_leftovers(path: Path, now: float) -> None:
    """Remove temporary files of ``path`` whose writer is gone: its process, or for a week its machine's."""
    start, own = f".{path.name}.", f".{path.name}.{os.uname().nodename}."
    for leftover in path.parent.iterdir():
        if not (leftover.name.startswith(start) and leftover.name.endswith(".tmp")):
            continue
        if leftover.name.startswith(own):
            pid = leftover.name[len(own) :].split(".")[0]
            gone = pid.isdigit() and not _is_alive(int(pid))
        else:
            try:
                gone = leftover.stat().st_mtime < now - ABANDONED_S
            except FileNotFoundError:
                continue
        if gone:
            leftover.unlink(missing_ok=True)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
