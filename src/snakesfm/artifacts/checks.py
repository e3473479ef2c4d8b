"""Checks that the files a job is about to read belong to its scene and configuration."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from snakesfm.artifacts import ARTIFACTS
from snakesfm.artifacts.base import read_header
from snakesfm.digests import options_digest
from snakesfm.errors import ArtifactError

ASIDE = ".refused"


def check_inputs(paths: Iterable[Path], scene: str, digests: Mapping[str, str]) -> None:
    """Set aside every artifact that is damaged or not of this scene and configuration.

    Snakemake sees that a file is there and how old it is, not what it holds. A file that was set aside is
    missing, so the next run makes it again.

    Parameters
    ----------
    paths : files to look at; only their headers are read, and what is no HDF5 file is left alone.
    scene : the scene that they must be of.
    digests : options digest by stage.

    Raises
    ------
    ArtifactError : at least one file was set aside; or one cannot be read now, and none was.
    """
    _raise_for(set_aside(paths, scene, digests))


def check_content(paths: Iterable[Path]) -> None:
    """Set aside every artifact whose columns are not what was written; for jobs that failed to read one.

    Parameters
    ----------
    paths : files to look at, which are read whole; what is no artifact is left alone.

    Raises
    ------
    ArtifactError : at least one file was set aside; or one cannot be read now, and none was.
    """
    kinds = {cls.kind: cls for cls in ARTIFACTS}
    damaged = []
    for path in paths:
        cls = kinds.get(str(read_header(path).get("artifact"))) if path.suffix == ".h5" else None
        if cls is not None and cls.read_former(path) is None:
            damaged.append(path)
    _raise_for([_rename(path, "is damaged") for path in damaged])


def set_aside(
    paths: Iterable[Path],
    scene: str,
    digests: Mapping[str, str],
    settings: Callable[[str, Path], str] = lambda stage, path: "",
) -> list[str]:
    """Rename every artifact that is damaged or not of this scene and configuration to ``*.refused``.

    Parameters
    ----------
    paths, scene, digests : as in :func:`check_inputs`.
    settings : what a file of a stage should say of its seed and settings; empty if it may say anything. One
        that says nothing, as simulated ones do, is not refused for it.

    Returns
    -------
    One clause per file that was renamed.

    Raises
    ------
    UnreadableArtifactError : a file cannot be read now; none was renamed.
    """
    files = [path for path in paths if path.suffix == ".h5" and path.is_file()]
    reasons = [_reason(path, scene, digests, settings) for path in files]
    return [_rename(path, reason) for path, reason in zip(files, reasons, strict=True) if reason]


def _rename(path: Path, reason: str) -> str:
    path.replace(path.with_name(path.name + ASIDE))
    return f"{path} {reason}"


def _raise_for(refused: list[str]) -> None:
    if refused:
        more = f" (and {len(refused) - 1} more)" if len(refused) > 1 else ""
        raise ArtifactError(
            f"{refused[0]}{more}: it was renamed to *{ASIDE}; start the same command again to recreate it."
        )


def _reason(
    path: Path, scene: str, digests: Mapping[str, str], settings: Callable[[str, Path], str]
) -> str:
    """Why a file cannot be used; empty where it can be."""
    header = read_header(path)
    if not header:
        return "is damaged"
    stage = str(header.get("stage"))
    if stage not in digests:
        return f"is of stage '{stage}'"
    if header.get("scene") != scene:
        return f"is of scene '{header.get('scene')}'"
    if options_digest(header.get("stage_version", 0), str(header.get("options"))) != digests[stage]:
        return f"is of another version or other options of {stage}"
    made, wanted = header.get("settings", ""), settings(stage, path)
    if made and wanted and made != wanted:
        return f"is of other images, other inputs of {stage} or another seed"
    return ""
