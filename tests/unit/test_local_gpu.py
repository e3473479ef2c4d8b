"""One job at a time on the GPU of a machine."""

from types import SimpleNamespace

from snakesfm.local_gpu import DRIVER_TOOL, limit_gpu_jobs


def test_a_machine_with_a_gpu_runs_one_job_on_it(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    scheduler = SimpleNamespace(global_resources={"_cores": 8}, resources={"_cores": 8})
    limit_gpu_jobs(scheduler)
    assert scheduler.global_resources == scheduler.resources == {"_cores": 8}
    (tmp_path / DRIVER_TOOL).touch(0o755)
    limit_gpu_jobs(scheduler)
    assert scheduler.global_resources == scheduler.resources == {"_cores": 8, "gpu": 1}


def test_a_number_of_the_user_stays(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / DRIVER_TOOL).touch(0o755)
    scheduler = SimpleNamespace(global_resources={"gpu": 4}, resources={"gpu": 4})
    limit_gpu_jobs(scheduler)
    assert scheduler.global_resources == scheduler.resources == {"gpu": 4}
