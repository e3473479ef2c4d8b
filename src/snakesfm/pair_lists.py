"""The list of pairs given for a scene: a text file, or hloc's matches.

The Snakefile asks this while it is parsed, so what reads HDF5 is loaded only where there is such a file.
"""

from pathlib import Path

from snakesfm.digests import file_digest, file_state
from snakesfm.errors import ConfigError
from snakesfm.hloc_files import MATCHES, PAIRS

# the ending by which a file of matches is told from a text file
MATCHES_SUFFIX = ".h5"


def find_pair_list(folder: Path) -> str:
    """The list of pairs in a folder of hloc's files, or else its matches, which name pairs; "" for none."""
    files = (folder / PAIRS, folder / MATCHES)
    return next((str(path) for path in files if path.is_file()), "")


def is_matches_file(path: str) -> bool:
    """Whether a list of pairs is a file of matches."""
    return Path(path).suffix == MATCHES_SUFFIX


def pair_list_state(path: str) -> str:
    """What changes when a list of pairs does; "" for no list."""
    return file_state(Path(path).expanduser()) if is_matches_file(path) else file_digest(path)


def estimate_pair_count(path: str) -> int:
    """How many lines a list of pairs has; of matches about how many pairs, 0 if it is no HDF5 file."""
    file = Path(path).expanduser()
    if not is_matches_file(path):
        return len(file.read_text("utf-8", errors="replace").splitlines())
    from snakesfm.artifacts.hloc import estimate_hloc_pairs, open_hloc

    try:
        with open_hloc(file) as matches:
            return estimate_hloc_pairs(matches)
    except ConfigError:
        # the job that reads the pairs says so
        return 0
