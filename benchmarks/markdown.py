"""Rows of Markdown tables."""

from collections.abc import Sequence


def markdown_row(cells: Sequence[str]) -> str:
    """One row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def markdown_head(cells: Sequence[str]) -> list[str]:
    """The first two rows of a Markdown table."""
    return [markdown_row(cells), f"|{'---|' * len(cells)}"]
