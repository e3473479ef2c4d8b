"""Results shared by several runs: a folder of artifacts named by the digest of all they depend on.

A stage that takes unchanged images or pairs from its former file takes them from here as well. Every image
or pair is compared by its own digest again, so a wrong or damaged file costs time and never a result; who
finds one puts another in its place.
"""

import hashlib
import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from snakesfm.atomic import atomic_path

VARIABLE = "SNAKESFM_CACHE"


def cached_path(stage: str, digests: Iterable[str]) -> Path | None:
    """Where the shared folder keeps a stage's file of these images or pairs; None without such a folder.

    Parameters
    ----------
    stage : verb_noun name of the stage.
    digests : per image or pair of the file the digest of all that its result depends on.
    """
    folder = os.environ.get(VARIABLE)
    if not folder:
        return None
    name = hashlib.sha256("\n".join((stage, *digests)).encode()).hexdigest()
    return Path(folder).expanduser() / stage / name[:2] / f"{name}.h5"


def share(path: Path, cached: Path, replace: bool = False) -> None:
    """Put a finished file into the shared folder, complete or not at all; a link where that is possible.

    Parameters
    ----------
    path : the finished file.
    cached : its place, see :func:`cached_path`.
    replace : whether to replace a file that is there, as a damaged one.
    """
    try:
        # its name is a digest of what it holds
        if not replace and cached.exists():
            return
        with atomic_path(cached) as temporary:
            temporary.unlink()
            try:
                temporary.hardlink_to(path)
            except OSError:
                shutil.copyfile(path, temporary)
    except OSError as error:
        print(f"warning: {cached} could not be shared ({error}); correct {VARIABLE} or unset it.")
