"""Whole runs on a SLURM of virtual nodes, through every fault that a cluster has to offer."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from extras import import_extra
from slurm_cluster import Cluster, missing_programs, wait_for
from workflow_runner import Workflow, config_of, copy_run, model_bytes

# polls as often as a test wants; everything else is the profile's
QUICK = ("--seconds-between-status-checks", "1", "--max-status-checks-per-second", "2")
OUTAGE_S = 15

pytestmark = [
    pytest.mark.workflow,
    pytest.mark.skipif(
        bool(missing_programs()),
        reason=f"not installed: {', '.join(missing_programs())} (slurm-wlm, munge)",
    ),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    """Four nodes of two cores each. Its folder has a short name: a socket's path is limited."""
    import_extra("snakemake_executor_plugin_slurm", "slurm")
    with tempfile.TemporaryDirectory(prefix="slurm") as folder:
        cluster = Cluster(Path(folder), nodes=4, cpus=2)
        try:
            cluster.start()
            yield cluster
        finally:
            cluster.stop()


@pytest.fixture
def on_slurm(cluster: Cluster, tmp_path: Path) -> Workflow:
    return Workflow(tmp_path, "slurm", cluster.environment)


def process_of(log: Path) -> tuple[int, str] | None:
    """The process that writes a job's log now, and the SLURM job that it is of."""
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if (process / "fd" / "1").readlink() == log:
                found = re.search(rb"SLURM_JOB_ID=(\d+)", (process / "environ").read_bytes())
                if found:
                    return int(process.name), found[1].decode()
    return None


def wait_for_process(log: Path, run: subprocess.Popen[str] | None = None) -> tuple[int, str]:
    wait_for(lambda: process_of(log) or (run and run.poll() is not None), f"a job that writes {log}", 400)
    found = process_of(log)
    assert found is not None, f"{log}: the job or the run ended too early"
    return found


class Storm:
    """Faults that come down on a run, each on a job of its own."""

    def __init__(self, cluster: Cluster, scene: Path) -> None:
        self.cluster = cluster
        self.logs = scene / "logs"
        self.victims: dict[str, str] = {}

    def preempt(self) -> None:
        """Have a more important job take the node of one that finds features."""
        pid, number = wait_for_process(self.logs / "extract_features" / "0.log")
        self.victims["preempted"] = number
        os.kill(pid, signal.SIGSTOP)
        node = self.cluster.job(number)["NodeList"]
        taking = ("--partition=urgent", f"--nodelist={node}", "--exclusive", "--mem=1000")
        self.cluster.call("sbatch", *taking, "--output=/dev/null", "--wrap=true")

    def hang(self) -> None:
        """Stop the process of a tile for ever."""
        pid, self.victims["hung"] = wait_for_process(self.logs / "match_pairs" / "0-0.log")
        os.kill(pid, signal.SIGSTOP)

    def cancel(self) -> None:
        """Cancel a running tile."""
        _, self.victims["cancelled"] = wait_for_process(self.logs / "match_pairs" / "0-1.log")
        self.cluster.call("scancel", self.victims["cancelled"])

    def lose_node(self) -> None:
        """Lose the node of a tile with all that runs on it; later the node comes back."""
        _, number = wait_for_process(self.logs / "match_pairs" / "1-1.log")
        self.victims["lost"] = number
        node = self.cluster.job(number)["NodeList"]
        self.cluster.kill(node)
        self.cluster.kill_processes(number)
        wait_for(lambda: self.cluster.job(number)["JobState"] == "NODE_FAIL", "a lost node", 120)
        self.cluster.start_node(node)


@pytest.fixture(scope="module")
def survived(
    cluster: Cluster, small_scene: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str, dict[str, str]]:
    """A whole run in a storm: its output folder, what it printed, and the SLURM jobs that were hit."""
    folder = tmp_path_factory.mktemp("storm")
    shared = {"SNAKESFM_CACHE": str(folder / "shared")}
    run = Workflow(folder, "slurm", {**cluster.environment, **shared}).start(
        *QUICK,
        # each tile has a node of its own
        *("--retries", "3", "--set-threads", "match_pairs=2"),
        *(
            "--set-resources",
            "match_pairs:runtime=attempt",
            "calibrate_cameras:mem_mb=min(100 * attempt**4, 5000)",
        ),
        *config_of(small_scene),
    )
    storm = Storm(cluster, folder / "out" / "square")
    faults = [storm.preempt, storm.hang, storm.cancel, storm.lose_node]
    threads = [threading.Thread(target=fault, daemon=True) for fault in faults]
    for thread in threads:
        thread.start()
    text, _ = run.communicate(timeout=900)
    assert run.returncode == 0, text
    for thread in threads:
        thread.join(30)
    return folder / "out" / "square", text, storm.victims


def test_a_run_on_slurm_gives_the_model_of_a_local_run_whatever_happens(finished, survived) -> None:
    output = survived[0]
    assert model_bytes(output) == model_bytes(finished[0])
    assert not list(output.rglob("*.tmp"))
    assert not list(output.rglob("*.refused"))


def test_the_folder_that_runs_share_is_used_on_the_nodes(survived) -> None:
    kept = [path.parts[-3] for path in (survived[0].parents[1] / "shared").rglob("*.h5")]
    assert sorted(kept) == ["estimate_two_view"] * 3 + ["extract_features"] * 2 + ["match_pairs"] * 3


def test_logs_of_all_jobs_are_with_the_scene(finished, survived) -> None:
    logs = {str(path.relative_to(survived[0])) for path in survived[0].glob("logs/*/*.log")}
    assert logs == {str(path.relative_to(finished[0])) for path in finished[0].glob("logs/*/*.log")}


@pytest.mark.parametrize(
    ("fault", "state"),
    [
        ("preempted", "PREEMPTED"),
        ("hung", "TIMEOUT"),
        ("cancelled", "CANCELLED"),
        ("lost", "NODE_FAIL"),
    ],
)
def test_a_job_that_was_hit_is_run_again(cluster: Cluster, survived, fault: str, state: str) -> None:
    number = survived[2][fault]
    assert cluster.job(number)["JobState"] == state
    assert re.search(rf"SLURM-job '{number}' (failed|was preempted)", survived[1])


def test_a_job_over_its_time_gets_more(cluster: Cluster, survived) -> None:
    limits = [cluster.job(number)["TimeLimit"] for number in cluster.jobs("COMPLETED")]
    assert cluster.job(survived[2]["hung"])["TimeLimit"] == "00:01:00"
    assert "00:02:00" in limits


def test_a_job_over_its_memory_gets_more(cluster: Cluster, survived) -> None:
    failed = [cluster.job(number)["MinMemoryNode"] for number in cluster.jobs("FAILED", "OUT_OF_MEMORY")]
    completed = [cluster.job(number)["MinMemoryNode"] for number in cluster.jobs("COMPLETED")]
    assert "100M" in failed
    assert {"1600M", "5000M"} & set(completed)


def test_a_controller_that_is_ended_leaves_nothing_that_hinders_the_next(
    finished, small_scene: Path, cluster: Cluster, on_slurm: Workflow
) -> None:
    copy_run(finished[0], on_slurm.folder)
    output = on_slurm.folder / "out" / "square"
    arguments = [*QUICK, *config_of(small_scene)]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        (output / "adjust_bundle" / "reconstruction.h5").unlink(missing_ok=True)
        shutil.rmtree(output / "logs" / "adjust_bundle")
        run = on_slurm.start(*arguments)
        pid, job = wait_for_process(output / "logs" / "adjust_bundle" / "job.log", run)
        if number == signal.SIGKILL:
            os.kill(pid, signal.SIGSTOP)
            second = on_slurm.run(*arguments)
            assert second.status != 0
            assert re.search(
                rf"Another run \(process {run.pid} on .*SLURM run .*\) is writing", second.text
            )
            assert second.rules == []
        run.send_signal(number)
        text, _ = run.communicate(timeout=120)
        assert run.returncode != 0, text
        if number == signal.SIGKILL:
            assert job in cluster.jobs("RUNNING")
    last = on_slurm.run(*arguments)
    assert last.status == 0, last.text
    assert "1 SLURM jobs of an interrupted run were cancelled" in last.text
    assert "unlock" not in last.text
    assert cluster.job(job)["JobState"] == "CANCELLED"
    assert model_bytes(output) == model_bytes(finished[0])
    assert not list(output.rglob("*.tmp"))


def test_a_job_that_slurm_will_not_start_is_named(
    finished, small_scene: Path, cluster: Cluster, on_slurm: Workflow
) -> None:
    copy_run(finished[0], on_slurm.folder)
    (on_slurm.folder / "out" / "square" / "render_report" / "index.html").unlink()
    limited = ("--default-resources", "slurm_partition=short", "disk_mb=1000")
    run = on_slurm.start(*QUICK, *limited, *config_of(small_scene))
    wait_for(lambda: cluster.jobs("PENDING"), "a job that is longer than its partition allows", 120)
    # so many seconds later jobs are asked for
    time.sleep(10)
    run.send_signal(signal.SIGINT)
    text, _ = run.communicate(timeout=120)
    assert re.search(r"SLURM does not start job \d+ \(render_report\): PartitionTimeLimit\.", text), text
    assert cluster.jobs() == []


def test_an_interrupt_while_jobs_are_submitted_leaves_none(
    finished, small_scene: Path, cluster: Cluster, tmp_path: Path
) -> None:
    copy_run(finished[0], tmp_path)
    output, programs = tmp_path / "out" / "square", tmp_path / "bin"
    for block in range(2):
        (output / "extract_features" / f"{block}.h5").unlink()
    programs.mkdir()
    slow = programs / "sbatch"
    slow.write_text(f'#!/bin/sh\ntouch {tmp_path}/asked\nsleep 4\nexec {cluster.folder}/bin/sbatch "$@"\n')
    slow.chmod(0o755)
    environment = {**cluster.environment, "PATH": f"{programs}:{cluster.environment['PATH']}"}
    run = Workflow(tmp_path, "slurm", environment).start(*QUICK, *config_of(small_scene))
    wait_for((tmp_path / "asked").exists, "a job that is being submitted", 120)
    run.send_signal(signal.SIGINT)
    text, _ = run.communicate(timeout=120)
    assert "2 SLURM jobs of an interrupted run were cancelled." in text
    assert cluster.jobs() == []
    assert (tmp_path / "out" / ".snakesfm.lock").read_text() == ""


def test_what_is_edited_while_a_run_goes_on_is_for_the_next(
    finished, small_scene: Path, cluster: Cluster, on_slurm: Workflow
) -> None:
    copy_run(finished[0], on_slurm.folder)
    output = on_slurm.folder / "out" / "square"
    (output / "adjust_bundle" / "reconstruction.h5").unlink()
    shutil.rmtree(output / "logs" / "adjust_bundle")
    file = on_slurm.folder / "mine.yaml"
    file.write_text("export_model: {all_keypoints: false}\n")
    arguments = [*QUICK, "--configfile", "mine.yaml", *config_of(small_scene)]
    run = on_slurm.start(*arguments)
    # the model is exported by a SLURM job that starts later
    pid, _ = wait_for_process(output / "logs" / "adjust_bundle" / "job.log", run)
    os.kill(pid, signal.SIGSTOP)
    file.write_text("export_model: {all_keypoints: true}\n")
    # so many images are dealt into other blocks
    late = [small_scene / "images" / f"late_{number}.jpg" for number in range(50)]
    try:
        for image in late:
            image.touch()
        os.kill(pid, signal.SIGCONT)
        text, _ = run.communicate(timeout=300)
    finally:
        for image in late:
            image.unlink(missing_ok=True)
    assert run.returncode == 0, text
    assert model_bytes(output) == model_bytes(finished[0])
    last = on_slurm.run(*arguments)
    assert last.status == 0, last.text
    assert model_bytes(output) != model_bytes(finished[0])


@pytest.mark.parametrize("forgets", [False, True])
def test_a_run_goes_on_when_slurm_is_back(
    finished, small_scene: Path, cluster: Cluster, on_slurm: Workflow, forgets: bool
) -> None:
    copy_run(finished[0], on_slurm.folder)
    output = on_slurm.folder / "out" / "square"
    (output / "render_report" / "index.html").unlink()
    shutil.rmtree(output / "logs" / "render_report")
    run = on_slurm.start(*QUICK, *config_of(small_scene))
    wait_for_process(output / "logs" / "render_report" / "job.log", run)
    cluster.kill("slurmctld")
    if forgets:
        cluster.forget_jobs()
    time.sleep(OUTAGE_S)
    assert run.poll() is None
    cluster.start_controller()
    text, _ = run.communicate(timeout=300)
    assert run.returncode == 0, text
    assert not forgets or re.search(r"SLURM no longer knows job \d+", text)
    assert (output / "render_report" / "index.html").is_file()
    assert model_bytes(output) == model_bytes(finished[0])


def test_jobs_that_cannot_be_ended_are_named_with_what_to_type(
    finished, small_scene: Path, tmp_path: Path
) -> None:
    copy_run(finished[0], tmp_path)
    (tmp_path / "out" / "square" / "render_report" / "index.html").unlink()
    (tmp_path / "out" / ".snakesfm.lock").write_text("process 1 on elsewhere, SLURM run some-name\n")
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "squeue").write_text("#!/bin/sh\nexit 1\n")
    (programs / "squeue").chmod(0o755)
    silent = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    outcome = Workflow(tmp_path, environment=silent).run(*config_of(small_scene))
    assert outcome.status != 0
    assert "scancel --name=some-name" in outcome.text
    assert outcome.rules == []
