"""Rows of arrays that belong together."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def rows_of_each(values: Array) -> list[tuple[int, Array]]:
    """Each distinct of the values (n,) int, ascending, and the rows (k,) that have it, ascending."""
    if not len(values):
        return []
    order = np.argsort(values, kind="stable")
    found, starts = np.unique(values[order], return_index=True)
    return list(zip(found.tolist(), np.split(order, starts[1:]), strict=True))
