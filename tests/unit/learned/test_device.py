"""Where networks run."""

import pytest
from extras import import_extra

from snakesfm.errors import ConfigError
from snakesfm.learned import device


@pytest.fixture(autouse=True)
def torch():
    yield import_extra("torch")
    device.use_device("auto")


@pytest.mark.parametrize("there", [False, True])
def test_a_device_is_chosen_as_the_run_wants_it(monkeypatch, torch, there):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    device.use_device("auto")
    assert device.choose_device().type == ("cuda" if there else "cpu")
    device.use_device("cpu")
    assert device.choose_device().type == "cpu"


def test_a_missing_device_is_one_sentence(monkeypatch, torch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(
        ConfigError, match=r"finds no CUDA device: request .*slurm-gpu.* or set device=cpu\.$"
    ):
        device.use_device("cuda")
