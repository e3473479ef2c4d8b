"""Tables that a command writes into a page that people write."""

from pathlib import Path


def replace_table(page: Path, command: str, table: str) -> None:
    """Put a table between the marks of a command in a page.

    Parameters
    ----------
    page : a Markdown file that holds ``<!-- COMMAND -->`` and, below it, ``<!-- end -->``, each on a line.
    command : the command's name.
    table : lines of Markdown that end with a line break.
    """
    begin, end = f"<!-- {command} -->\n", "<!-- end -->\n"
    before, found, rest = page.read_text("utf-8").partition(begin)
    if not found or end not in rest:
        raise SystemExit(f"{page} has no place for the table: put the lines {begin!r} and {end!r} into it.")
    page.write_text(before + begin + table + end + rest.split(end, 1)[1], "utf-8")
