"""Matching of image names between two lists, and their natural order."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from snakesfm.arrays import Array


def match_names(names: Sequence[str], reference_names: Sequence[str]) -> Array:
    """For each reference image the row of the same image in ``names``, -1 where there is none.

    Relative paths decide; where a path is in no other list, the file name alone does if it is unique
    in both, else without its suffix, as of images that were converted.
    """
    rows = {name: row for row, name in enumerate(names)}
    matched = np.array([rows.get(name, -1) for name in reference_names], dtype=np.int64)
    for part in ("name", "stem"):
        by_part: dict[str, list[int]] = {}
        for row, name in enumerate(names):
            by_part.setdefault(getattr(PurePosixPath(name), part), []).append(row)
        reference_parts = [getattr(PurePosixPath(name), part) for name in reference_names]
        counts = Counter(reference_parts)
        for row in np.flatnonzero(matched < 0).tolist():
            candidates = by_part.get(reference_parts[row], [])
            # no two references get the same row: all that could have its part
            if len(candidates) == 1 and counts[reference_parts[row]] == 1:
                matched[row] = candidates[0]
    return matched


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Sort key that puts img2 before img10."""
    parts = re.split(r"(\d+)", name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], name
