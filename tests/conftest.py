"""Fixtures shared by all tests."""

from pathlib import Path

import pytest
from workflow_runner import Outcome, Workflow

from snakesfm.synthetic.render_demo import make_demo
from snakesfm.synthetic.scene import DemoOptions

ROOT = Path(__file__).resolve().parents[1]
SMALL = DemoOptions(image_count=16, width=400, height=300)
DATA = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def root() -> Path:
    """The project's folder."""
    return ROOT


@pytest.fixture(scope="session")
def data() -> Path:
    """The real image sets, beside the project; tests that need them are skipped where they are absent."""
    if not DATA.is_dir():
        pytest.skip(f"the real image sets are not there ({DATA})")
    return DATA


@pytest.fixture
def workflow(tmp_path: Path) -> Workflow:
    return Workflow(tmp_path)


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered scene of 16 small images with its reference."""
    folder = tmp_path_factory.mktemp("scene") / "square"
    make_demo(folder, SMALL)
    return folder


@pytest.fixture(scope="session")
def finished(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """The small scene reconstructed once without disturbance: its output folder and what was printed."""
    folder = tmp_path_factory.mktemp("finished")
    config = [f"images={small_scene / 'images'}", f"reference={small_scene / 'reference'}", "output=out"]
    outcome = Workflow(folder).run("--config", *config)
    assert outcome.status == 0, outcome.text
    return folder / "out" / "square", outcome
