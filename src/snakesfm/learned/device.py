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


_wanted = "auto"


def use_device(wanted: str) -> None:
    """Let this process's networks run on 'cpu', on 'cuda', or with 'auto' on CUDA where there is some.

    Raises
    ------
    ConfigError : CUDA is wanted and there is none.
    """
    global _wanted
    if wanted == "cuda" and not load_torch().cuda.is_available():
        raise ConfigError(
            "device is 'cuda', but the job finds no CUDA device: request one from the cluster with "
            "--profile profiles/slurm-gpu on a partition with GPUs, or set device=cpu."
        )
    _wanted = wanted


def choose_device() -> Any:
    """The first CUDA device where there is one and the run wants it, else the processor."""
    torch = load_torch()
    return torch.device("cuda" if _wanted != "cpu" and torch.cuda.is_available() else "cpu")


def use_threads(threads: int) -> None:
    """Let networks on the processor use so many threads."""
    load_torch().set_num_threads(threads)
