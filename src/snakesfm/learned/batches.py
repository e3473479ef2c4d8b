"""Batches of images or pairs for a network: their size, and which items fit together."""

from collections.abc import Hashable, Sequence
from typing import Literal

from snakesfm.learned.device import choose_device

# on a processor larger batches take as long or longer, and each member its own memory (docs/front_ends.md)
CPU_BATCH, CUDA_BATCH = 1, 4


def choose_batch_size(wanted: int | Literal["auto"]) -> int:
    """The number itself, or what 'auto' means on the device that networks run on."""
    if wanted != "auto":
        return wanted
    return CUDA_BATCH if choose_device().type == "cuda" else CPU_BATCH


def equal_rows(keys: Sequence[Hashable]) -> list[list[int]]:
    """The rows of each key, keys in the order of their first rows."""
    rows: dict[Hashable, list[int]] = {}
    for row, key in enumerate(keys):
        rows.setdefault(key, []).append(row)
    return list(rows.values())


def in_batches(keys: Sequence[Hashable], size: int) -> list[list[int]]:
    """The rows in batches of ``size`` or fewer, rows of equal keys one after the other."""
    return cut([row for same in equal_rows(keys) for row in same], size)


def cut(rows: list[int], size: int) -> list[list[int]]:
    """Rows in their order, ``size`` at a time; the last ones may be fewer."""
    return [rows[start : start + size] for start in range(0, len(rows), size)]
