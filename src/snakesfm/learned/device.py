"""The processor or CUDA device that networks run on, and the torch library itself."""

import fcntl
import importlib
import os
import tempfile
from pathlib import Path
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
_turns: dict[str, Any] = {}


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
    if choose_device().type == "cuda":
        take_turn(str(load_torch().cuda.get_device_properties(0).uuid))


def take_turn(device: str) -> None:
    """Wait until no other job of this user on this machine holds the device, then hold it to the end.

    Two jobs together often do not fit into its memory, and they are no faster than one after the other.
    ``device`` is what identifies it among all of the machine, whichever of them the process may see.
    """
    if device in _turns:
        return
    path = Path(tempfile.gettempdir()) / f"snakesfm-{os.getuid()}-{device}.lock"
    _turns[device] = path.open("a")
    fcntl.flock(_turns[device], fcntl.LOCK_EX)


def choose_device() -> Any:
    """The first CUDA device where there is one and the run wants it, else the processor."""
    torch = load_torch()
    return torch.device("cuda" if _wanted != "cpu" and torch.cuda.is_available() else "cpu")


def use_threads(threads: int) -> None:
    """Let networks on the processor use so many threads."""
    load_torch().set_num_threads(threads)
