"""What several workflow tests do with a finished run."""

import shutil
from pathlib import Path


def copy_run(output: Path, folder: Path) -> None:
    """Copy a finished run, with Snakemake's records, so that a test may disturb it."""
    shutil.copytree(output.parent, folder / "out", symlinks=True)
    shutil.copytree(output.parents[1] / ".snakemake", folder / ".snakemake", symlinks=True)


def model_bytes(output: Path) -> dict[str, bytes]:
    """The files of the exported model."""
    folder = output / "export_model" / "sparse" / "0"
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
