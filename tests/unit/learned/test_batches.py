"""Which images or pairs a network gets at once."""

import pytest
from extras import import_extra

from snakesfm.learned import batches, device


@pytest.mark.parametrize(("there", "expected"), [(False, batches.CPU_BATCH), (True, batches.CUDA_BATCH)])
def test_auto_depends_on_the_device(monkeypatch, there, expected):
    torch = import_extra("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    device.use_device("auto")
    assert batches.choose_batch_size("auto") == expected
    assert batches.choose_batch_size(7) == 7


def test_equal_keys_come_one_after_the_other_and_nothing_is_lost():
    keys = ["a", "b", "a", "c", "a", "b", "a"]
    assert batches.equal_rows(keys) == [[0, 2, 4, 6], [1, 5], [3]]
    assert batches.in_batches(keys, 3) == [[0, 2, 4], [6, 1, 5], [3]]
    assert batches.in_batches(keys, 1) == [[0], [2], [4], [6], [1], [5], [3]]
    assert batches.in_batches([], 3) == batches.equal_rows([]) == []
