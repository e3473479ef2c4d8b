"""Pairs of images that the user lists, in hloc's format."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from snakesfm.errors import ConfigError
from snakesfm.retrieval.pairs import PairTable


def listed_pairs(
    lines: Iterable[str], names: Sequence[str], refused: Iterable[str], source: str
) -> tuple[PairTable, int]:
    """Parse lines ``name0 name1``; names may hold spaces, a tab between the two always separates them.

    Spaces are all that Unicode calls so, such as the no-break space that word processors put.

    Parameters
    ----------
    lines : of the file; empty ones and those that start with ``#`` (and name no image) are skipped.
    names : names of the images, in the order of the index.
    refused : names of files that were found but cannot be used; their pairs are skipped.
    source : the file's path, for messages.

    Returns
    -------
    The pairs, and how many lines were skipped because of a refused image.

    Raises
    ------
    ConfigError : a line does not hold two names of images; says the file and the line.
    """
    rows = {name: row for row, name in enumerate(names)} | dict.fromkeys(refused, -1)
    pairs, skipped = [], 0
    for number, line in enumerate(lines, 1):
        text = line.strip("\r\n")
        if not text.strip():
            continue
        split = _split(text, rows)
        if split is None:
            if text.lstrip().startswith("#"):
                continue
            raise ConfigError(_explain(text, rows, f"{source}:{number}"))
        if -1 in split:
            skipped += 1
        else:
            pairs.append(split)
    return PairTable.of(np.array(pairs), "listed"), skipped


def _split(text: str, rows: Mapping[str, int]) -> tuple[int, int] | None:
    """The rows of the two names of a line, or None; the longest first name that works wins."""
    if "\t" in text:
        first, _, second = text.partition("\t")
        first, second = first.strip(), second.strip()
        return (rows[first], rows[second]) if first in rows and second in rows else None
    text = text.strip()
    for place in range(len(text) - 1, 0, -1):
        if text[place].isspace():
            first, second = text[:place].rstrip(), text[place:].strip()
            if first in rows and second in rows:
                return rows[first], rows[second]
    return None


def _explain(text: str, rows: Mapping[str, int], place: str) -> str:
    import difflib

    parts = text.split("\t") if "\t" in text else text.split()
    if len(parts) < 2:
        return f"{place}: '{text}' is not a pair of image names: write 'name0 name1' on each line."
    if len(parts) > 2:
        return (
            f"{place}: '{text}' does not split into two known image names: write them relative to the "
            "image folder, with a tab between them if they contain spaces."
        )
    unknown = next((part.strip() for part in parts if part.strip() not in rows), text)
    near = difflib.get_close_matches(unknown, list(rows), 1)
    hint = f"did you mean '{near[0]}'?" if near else "names are relative to the image folder."
    return f"{place}: there is no image '{unknown}'; {hint}"
