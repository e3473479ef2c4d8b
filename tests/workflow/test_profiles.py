"""The profiles: what they plan, and that they differ only where they say so."""

import re
from pathlib import Path

import pytest
import yaml
from extras import import_extra
from workflow_runner import Workflow

from snakesfm.pipeline import STAGES
from snakesfm.resources import FOLLOWING_MIN, START_MIN
from snakesfm.scene_plan import STAGES_WITH_NETWORKS

pytestmark = pytest.mark.workflow

CLUSTERS = ("slurm", "slurm-gpu", "kubernetes")


def read_profile(root: Path, name: str) -> dict:
    return yaml.safe_load((root / "profiles" / name / "profile.yaml").read_text())


def test_kubernetes_knows_whose_gpus_the_networks_want(root: Path) -> None:
    wanted = read_profile(root, "kubernetes")["set-resources"]
    # without limits, which 'scale: 0' asks for, the API refuses a request for GPUs
    expected = {"gpu_manufacturer": "nvidia", "scale": 0, "disk_mb": 8000}
    assert wanted == dict.fromkeys(STAGES_WITH_NETWORKS, expected)


def test_the_image_has_what_the_storage_of_kubernetes_calls(root: Path) -> None:
    assert read_profile(root, "kubernetes")["default-storage-provider"] == "fs"
    image = (root / "workflow" / "envs" / "Dockerfile").read_text()
    assert re.search(r"^RUN .*apt-get install .*\brsync\b", image, re.MULTILINE)
    assert "pip install --no-cache-dir -c constraints.txt '.[kubernetes]'" in image


def test_slurm_is_slurm_gpu_without_gpus(root: Path) -> None:
    plain, gpu = read_profile(root, "slurm"), read_profile(root, "slurm-gpu")
    assert plain.pop("set-resources") == {stage: {"gpu": 0} for stage in STAGES_WITH_NETWORKS}
    assert gpu == plain


@pytest.mark.parametrize("name", CLUSTERS)
def test_a_cluster_runs_jobs_by_the_same_rules_as_a_laptop(root: Path, name: str) -> None:
    local, cluster = read_profile(root, "local"), read_profile(root, name)
    for key in (
        "keep-going",
        "nolock",
        "rerun-incomplete",
        "rerun-triggers",
        "scheduler",
        "show-failed-logs",
    ):
        assert cluster[key] == local[key]


@pytest.mark.parametrize("name", CLUSTERS)
def test_jobs_that_follow_one_another_alone_are_grouped(root: Path, name: str) -> None:
    first, last = STAGES.index("build_view_graph"), STAGES.index("adjust_bundle")
    groups = {stage: "mapping" for stage in STAGES[first : last + 1]}
    groups |= {stage: "finish" for stage in ("export_model", "evaluate_model", "render_report")}
    assert read_profile(root, name)["groups"] == groups


@pytest.mark.parametrize("name", ["local", *CLUSTERS])
def test_the_readme_explains_every_value(root: Path, name: str) -> None:
    readme = root / "profiles" / ("README.md" if name == "local" else f"{name}/README.md")
    text = readme.read_text()
    if name == "kubernetes":
        text += (root / "profiles" / "slurm" / "README.md").read_text()
    if name == "slurm-gpu":
        text += (root / "profiles" / "slurm" / "README.md").read_text()
    for key in read_profile(root, name):
        if key != "printshellcmds":
            assert re.search(rf"`{key}\b", text), f"{readme} does not explain '{key}'"


@pytest.mark.parametrize("name", CLUSTERS)
def test_jobs_ask_for_memory_and_time(root: Path, small_scene: Path, tmp_path: Path, name: str) -> None:
    extra = name.split("-")[0]
    import_extra(f"snakemake_executor_plugin_{extra}", extra)
    storage = ["--default-storage-prefix", str(tmp_path)] if name == "kubernetes" else []
    outcome = Workflow(tmp_path, name).run(
        "--dry-run", *storage, "--config", f"images={small_scene / 'images'}", "output=out"
    )
    assert outcome.status == 0, outcome.text
    assert re.search(r"^total +22$", outcome.text, re.M)
    needs = re.findall(r"^ *resources: (.*)$", outcome.text, re.M)
    asking = [need for need in needs if "runtime=" in need]
    assert len(asking) == 21
    # on Kubernetes the disk is a limit where a GPU may be asked for
    plain = [need for need in asking if "disk_mb=1000" in need]
    larger = [need for need in asking if "disk_mb=8000" in need and "gpu=0" in need]
    assert (len(plain), len(larger)) == ((16, 5) if name == "kubernetes" else (21, 0))
    for need in asking:
        assert 500 <= int(re.search(r"mem_mb=(\d+)", need)[1]) <= 3_000
    minutes = re.findall(r"^ *rule (\w+):$(?:\n.+)*?\n *resources: .*runtime=(\d+)", outcome.text, re.M)
    assert len(minutes) == 21
    following = read_profile(root, name)["groups"].keys() - {"build_view_graph", "export_model"}
    for rule, count in minutes:
        least, most = (FOLLOWING_MIN, START_MIN) if rule in following else (START_MIN, 30)
        assert least < int(count) < most, rule
    assert not [need for need in needs if "gpu=1" in need]


@pytest.mark.parametrize(
    ("undistort", "cores", "given", "threads"),
    [(True, 8, None, 4), (True, 16, 8, 8), (False, 8, None, 1)],
)
def test_undistorted_images_have_threads_and_ask_for_their_memory(
    tmp_path: Path, undistort: bool, cores: int, given: int | None, threads: int
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for number in range(3):
        (images / f"{number}.jpg").write_bytes(b"image %d" % number)
    arguments = ["--set-threads", f"export_model={given}"] if given else []
    options = [f"images={images}", "output=out", f"export_model={{undistort: {str(undistort).lower()}}}"]
    outcome = Workflow(tmp_path).run("--dry-run", *arguments, "--config", *options, cores=cores)
    assert outcome.status == 0, outcome.text
    job = re.search(r"^rule export_model:\n(.*?)^$", outcome.text, re.M | re.S)[1]
    # of one thread Snakemake says nothing
    found = re.search(r"^ +threads: (\d+)$", job, re.M)
    assert int(found[1] if found else 1) == threads
    workers = threads if undistort else 0
    assert 1_000 + 500 * (workers - 1) < int(re.search(r"mem_mb=(\d+)", job)[1]) <= 1_000 + 500 * workers


@pytest.mark.parametrize(("name", "gpus"), [("slurm", 0), ("slurm-gpu", 5)])
def test_networks_ask_for_a_gpu_where_the_profile_has_them(
    small_scene: Path, tmp_path: Path, name: str, gpus: int
) -> None:
    import_extra("snakemake_executor_plugin_slurm", "slurm")
    outcome = Workflow(tmp_path, name).run(
        "--dry-run",
        "--config",
        f"images={small_scene / 'images'}",
        "output=out",
        "front_end=aliked+lightglue",
    )
    assert outcome.status == 0, outcome.text
    assert len(re.findall(r"^ *resources: .*gpu=1", outcome.text, re.M)) == gpus
