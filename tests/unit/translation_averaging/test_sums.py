"""Sums of rows over the groups that they belong to."""

import numpy as np
import pytest

from snakesfm.translation_averaging.landmarks import sum_by


@pytest.mark.parametrize("shape", [(), (3,), (3, 3)])
@pytest.mark.parametrize("rows", [0, 1, 5000])
def test_sums_are_those_of_adding_row_by_row_to_the_bit(shape: tuple[int, ...], rows: int) -> None:
    rng = np.random.default_rng(3)
    values, groups = rng.normal(size=(rows, *shape)), rng.integers(0, 70, rows)
    expected = np.zeros((80, *shape))
    np.add.at(expected, groups, values)
    np.testing.assert_array_equal(sum_by(values, groups, 80), expected)
