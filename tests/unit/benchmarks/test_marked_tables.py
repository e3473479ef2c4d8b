"""Tables that commands write into pages."""

from pathlib import Path

import pytest

from benchmarks.marked_tables import replace_table


def test_only_what_stands_between_the_marks_of_the_command_is_replaced(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A\n\n<!-- one -->\nold\n<!-- end -->\n\n<!-- two -->\nkept\n<!-- end -->\nlast\n")
    replace_table(page, "one", "| new |\n")
    assert (
        page.read_text()
        == "# A\n\n<!-- one -->\n| new |\n<!-- end -->\n\n<!-- two -->\nkept\n<!-- end -->\nlast\n"
    )


def test_a_page_without_the_marks_is_refused_and_stays(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A\n")
    with pytest.raises(SystemExit, match="has no place for the table"):
        replace_table(page, "one", "| new |\n")
    assert page.read_text() == "# A\n"
