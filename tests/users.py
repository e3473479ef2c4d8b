"""Other users, whom permissions of files concern."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

NOBODY = 65534


@contextmanager
def without_root() -> Iterator[None]:
    """As a user whom permissions of files concern; the test is skipped where root is the only user."""
    user = os.geteuid()
    if user == 0:
        try:
            os.seteuid(NOBODY)
        except OSError as error:
            pytest.skip(f"root cannot become another user here ({error.strerror})")
    try:
        yield
    finally:
        if user == 0:
            os.seteuid(0)
