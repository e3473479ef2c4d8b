"""One name in all places: rule, script, stage module, options, results folder."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from workflow_runner import Workflow

from snakesfm.config.configuration import configuration_class, options_class
from snakesfm.pipeline import STAGES
from snakesfm.scene_plan import STAGES_IN_DETECTOR_PIXELS, STAGES_WITH_NETWORKS

DOMAIN_MAY_IMPORT_NOT = (
    "snakesfm.stages",
    "snakesfm.artifacts",
    "snakesfm.plan",
    "snakesfm.scene_plan",
    "snakesfm.job",
    "h5py",
    "snakemake",
)
NO_DOMAIN = {"stages", "artifacts", "config"}
NO_STAGES = {"fetch_weights", "hloc"}
# modules beside those of the stages
HELPERS = {"__init__", "job", "provisional_model"}
# those that do more than write files with a second thread
TWO_THREADS = {"index_images", "select_pairs", "calibrate_cameras", "adjust_bundle"}


def rule_texts(root: Path) -> dict[str, str]:
    """Rule name to text, of all rule files."""
    rules = {}
    for file in sorted((root / "workflow" / "rules").glob("*.smk")):
        text = file.read_text()
        for match in re.finditer(r"^( *)rule ?(\w*):\n(.*?)(?=^\S|\Z)", text, re.M | re.S):
            command = re.search(r'job_command\("(\w+)"\)', match[3])
            rules[match[2] or command[1]] = match[3]
    return rules


def test_every_stage_has_one_rule_script_module_and_config_block(root: Path) -> None:
    stages = set(STAGES)
    assert set(rule_texts(root)) - NO_STAGES == stages
    assert {p.stem for p in (root / "scripts").iterdir()} == stages
    assert {p.stem for p in (root / "src/snakesfm/stages").glob("*.py")} - HELPERS == stages
    assert {p.stem for p in (root / "src/snakesfm/config").glob("*.py")} - {
        "__init__",
        "base",
        "configuration",
    } == stages
    assert stages <= set(configuration_class().model_fields)


@pytest.mark.parametrize("stage", STAGES)
def test_rule_writes_to_the_folder_of_its_name_and_runs_its_script(root: Path, stage: str) -> None:
    text = rule_texts(root)[stage]
    output = re.search(r"output:\n(.*?)log:", text, re.S)[1]
    assert set(re.findall(r'artifact\(\s*"(\w+)"', output)) == {stage}
    assert text.count("files=job_files(),") == 1
    for directive in ("log_file", "job_params", "job_command", "memory_mb", "runtime_min"):
        assert re.findall(rf'{directive}\("(\w+)"', text) == [stage]
    assert re.findall(r'gpu=gpus\("(\w+)"', text) == [stage] * (stage in STAGES_WITH_NETWORKS)
    threads = ["2"] * (stage in TWO_THREADS) + ["undistorting_threads"] * (stage == "export_model")
    assert re.findall(r"threads:\s+(\w+)", text) == threads


@pytest.mark.parametrize("stage", STAGES)
def test_stage_is_told_the_detectors_pixels_if_it_converts_keypoints_to_them(
    root: Path, stage: str
) -> None:
    converts = "snakesfm.geometry.detector_pixels" in (
        root / "src/snakesfm/stages" / f"{stage}.py"
    ).read_text("utf-8")
    assert converts == (stage in STAGES_IN_DETECTOR_PIXELS)


@pytest.mark.parametrize("stage", STAGES)
def test_script_is_thin_and_stage_has_run(root: Path, stage: str) -> None:
    script = (root / "scripts" / f"{stage}.py").read_text()
    assert f'start_job("{stage}")' in script
    assert len(script.splitlines()) <= 10
    tree = ast.parse((root / "src/snakesfm/stages" / f"{stage}.py").read_text())
    assert "run" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert options_class(stage).stage_version >= 1


def domain_files() -> list[Path]:
    package = Path(__file__).resolve().parents[2] / "src" / "snakesfm"
    return [
        file
        for file in sorted(package.rglob("*.py"))
        if file.parent != package and file.relative_to(package).parts[0] not in NO_DOMAIN
    ]


@pytest.mark.parametrize("file", domain_files(), ids=lambda p: f"{p.parent.name}/{p.name}")
def test_domains_import_no_stage_no_artifact_and_no_workflow(file: Path) -> None:
    imported = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            imported.add(node.module)
    wrong = {
        name for name in imported for ban in DOMAIN_MAY_IMPORT_NOT if (name + ".").startswith(ban + ".")
    }
    assert not wrong


def imported_packages(file: Path) -> set[str]:
    """Packages, and modules beside them, of ``snakesfm`` that a file imports, inside of functions too."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("snakesfm.")}


def test_imports_between_packages_form_no_cycle(root: Path) -> None:
    source = root / "src" / "snakesfm"
    imports: dict[str, set[str]] = {}
    for file in sorted(source.rglob("*.py")):
        package = file.relative_to(source).with_suffix("").parts[0]
        imports.setdefault(package, set()).update(imported_packages(file) - {package})
    assert "grouping" in imports["view_graph"] and "stages" in imports["job"]
    # raises an error that names the packages of a cycle
    TopologicalSorter(imports).prepare()


def loads(node: ast.AST, package: str) -> bool:
    """Whether code imports a package when it runs; ``if TYPE_CHECKING:`` does not."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return any(loads(child, package) for child in node.orelse)
    if isinstance(node, ast.Import):
        return any(alias.name.split(".")[0] == package for alias in node.names)
    if isinstance(node, ast.ImportFrom):
        return not node.level and (node.module or "").split(".")[0] == package
    return any(loads(child, package) for child in ast.iter_child_nodes(node))


def test_pycolmap_is_imported_in_one_place_after_cv2(root: Path) -> None:
    source = root / "src" / "snakesfm"
    loading = {
        str(file.relative_to(source))
        for file in source.rglob("*.py")
        if loads(ast.parse(file.read_text()), "pycolmap")
    }
    assert loading == {"geometry/colmap_binding.py"}


def test_snakefile_is_a_table_of_contents(root: Path) -> None:
    lines = (root / "Snakefile").read_text().splitlines()
    included = {line.split("/")[-1][:-1] for line in lines if line.startswith("include:")}
    assert included == {file.name for file in (root / "workflow" / "rules").glob("*.smk")}
    assert len(lines) <= 60
    assert not [line for line in lines if re.match(r"\s*(def|lambda)\b", line)]


def test_no_source_file_is_too_long(root: Path) -> None:
    long = {
        str(file.relative_to(root)): count
        for folder in ("src", "tests")
        for file in sorted((root / folder).rglob("*.py"))
        if (count := len(file.read_text().splitlines())) > 450
    }
    assert not long


def test_runs_get_no_limit_of_threads_from_the_tests(workflow: Workflow) -> None:
    snakefile = workflow.folder / "Snakefile"
    snakefile.write_text(
        "import os\n"
        "print('limits:', *(name for name in os.environ if name.endswith('_NUM_THREADS')), file=open('told', 'a'))\n"
        "while 'wait' in config:\n    pass\n"
    )
    told = workflow.folder / "told"
    workflow.run("--snakefile", str(snakefile), "-n")
    with workflow.start("--snakefile", str(snakefile), "-n") as run:
        run.communicate(timeout=60)
    written = told.read_text()
    workflow.kill_when(
        lambda: told.read_text() != written, "--snakefile", str(snakefile), "-n", "--config", "wait=1"
    )
    assert told.read_text() == "limits:\n" * 3
