"""What a run does to the output folder before its jobs, and says of its results after them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from snakesfm.artifacts import Header, ImagePairs, checks
from snakesfm.errors import ConfigError
from snakesfm.plan import Plan
from snakesfm.run import Run


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plan:
    """Of two images, in a folder where Snakemake has no records."""
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        Path("images", name).write_bytes(name.encode())
    return Plan({"images": "images", "output": "out", "scene": "s"})


def start_and_end(plan: Plan) -> None:
    """A run takes the output folder's lock, and the system frees it."""
    run = Run(plan)
    try:
        run.start()
    finally:
        run.lock.close()


def test_no_other_run_starts_while_files_are_set_aside(
    plan: Plan, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    start_and_end(plan)
    file = Path("out/s/select_pairs/0-0.h5")
    ImagePairs([[0, 1]], ["listed"], [0.5], [2.0]).write(file, Header("select_pairs", 0, "s"))
    set_aside: Callable[..., list[str]] = checks.set_aside

    def start_another_first(*arguments: Any) -> list[str]:
        with pytest.raises(ConfigError, match="Another run"):
            start_and_end(plan)
        return set_aside(*arguments)

    monkeypatch.setattr(checks, "set_aside", start_another_first)
    Run(plan).refuse_unrecorded({"all"})
    assert "1 files without a record" in capsys.readouterr().out
    assert [path.name for path in file.parent.iterdir()] == ["0-0.h5.refused"]
    start_and_end(plan)
