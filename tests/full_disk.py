"""A disk on which pycolmap has no room for all that it writes."""

from pathlib import Path

import pycolmap
import pytest


def cut_references(monkeypatch: pytest.MonkeyPatch, method: str, file: str) -> None:
    """Have a method of models leave off the last byte of a file, in folders of references alone.

    The temporary files of the same method stay whole.
    """
    write = getattr(pycolmap.Reconstruction, method)

    def write_in_vain(model: pycolmap.Reconstruction, folder: str) -> None:
        write(model, folder)
        if Path(folder).name == "reference":
            cut = Path(folder) / file
            cut.write_bytes(cut.read_bytes()[:-1])

    monkeypatch.setattr(pycolmap.Reconstruction, method, write_in_vain)
