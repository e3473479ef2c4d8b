"""The processor or CUDA device that networks run on, and the torch library itself."""

import importlib
from typing import Any

from snakesfm.errors import ConfigError


def load_torch() -> Any:
    """The module torch.

    Raises
    ------
    ConfigError : it is not installed.
    """
    try:
        return importlib.import_module("torch")
    except ImportError:
        raise ConfigError(
            "Learned front-ends need torch and kornia, which are not installed: "
            "run 'pip install -c constraints.txt .[deep]' in snakesfm's folder."
        ) from None


def choose_device() -> Any:
    """The first CUDA device where there is one, else the processor."""
    torch = load_torch()
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def use_threads(threads: int) -> None:
    """Let networks on the processor use so many threads."""
    load_torch().set_num_threads(threads)
