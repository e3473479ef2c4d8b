"""Classes that are entries of a registry before their libraries are loaded."""

import importlib
from collections.abc import Callable
from typing import Any


def lazy(module: str, name: str) -> Callable[..., Any]:
    """A maker of a class of one of snakesfm's modules, which loads when the first is made."""

    def make(**options: Any) -> Any:
        return getattr(importlib.import_module(f"snakesfm.{module}"), name)(**options)

    return make
