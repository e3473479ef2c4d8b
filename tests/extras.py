"""Packages that the project can do without."""

import importlib.util
import os
from types import ModuleType

import pytest

# set by `make test`, which installs all of them
VARIABLE = "SNAKESFM_TEST_EXTRAS"


def import_extra(name: str, extra: str = "deep") -> ModuleType:
    """A module of an extra; where it is not installed the test is skipped, or fails if it is to be there."""
    if VARIABLE in os.environ and importlib.util.find_spec(name) is None:
        pytest.fail(f"the extra '{extra}' is not installed")
    return pytest.importorskip(name, reason=f"the extra '{extra}' is not installed")
