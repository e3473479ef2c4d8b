"""Fixtures shared by all tests."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def root() -> Path:
    """The project's folder."""
    return ROOT


@pytest.fixture(scope="session")
def data() -> Path:
    """The real image sets, beside the project; tests that need them are skipped where they are absent."""
    if not DATA.is_dir():
        pytest.skip(f"the real image sets are not there ({DATA})")
    return DATA
