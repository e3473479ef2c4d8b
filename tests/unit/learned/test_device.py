"""Where networks run."""

import subprocess
import sys
import tempfile
from types import SimpleNamespace

import pytest

from snakesfm.errors import ConfigError
from snakesfm.learned import device


@pytest.fixture(autouse=True)
def torch():
    yield pytest.importorskip("torch", reason="the extra 'deep' is not installed")
    device.use_device("auto")


@pytest.mark.parametrize("there", [False, True])
def test_a_device_is_chosen_as_the_run_wants_it(monkeypatch, torch, there):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    found = SimpleNamespace(uuid="12ab")
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: found)
    turns = []
    monkeypatch.setattr(device, "take_turn", turns.append)
    device.use_device("auto")
    assert device.choose_device().type == ("cuda" if there else "cpu")
    device.use_device("cpu")
    assert turns == (["12ab"] if there else [])
    assert device.choose_device().type == "cpu"


def test_a_missing_device_is_one_sentence(monkeypatch, torch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        ConfigError, match=r"finds no CUDA device: request .*slurm-gpu.* or set device=cpu\.$"
    ):
        device.use_device("cuda")


def test_jobs_take_turns_on_a_device(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(device, "_turns", {})
    device.take_turn("12ab")
    device.take_turn("12ab")  # of two networks of one job the second does not wait for the first
    script = f"""
import tempfile
tempfile.tempdir = {str(tmp_path)!r}
from snakesfm.learned.device import take_turn
take_turn("34cd")
print("other", flush=True)
take_turn("12ab")
print("same", flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "other\n"
        with pytest.raises(subprocess.TimeoutExpired):
            other.wait(0.5)
        device._turns.pop("12ab").close()
        assert other.stdout.readline() == "same\n"
    assert other.returncode == 0
