"""Rows that belong together: sums over groups, connected components, pairs taken one to one."""

import numpy as np
import pytest

from snakesfm.grouping import components_of, join_parts, offsets_of, one_to_one, starts_of, sum_by


def test_offsets_begin_at_zero_and_are_wide_integers() -> None:
    assert offsets_of([3, 0, 2]).tolist() == [0, 3, 3, 5]
    for few in ([], np.zeros(0), np.array([2**31 - 1, 1], np.int32), np.array([200, 100], np.uint8)):
        assert offsets_of(few).dtype == np.int64 and offsets_of(few)[-1] == sum(map(int, few))


def test_parts_are_joined_and_none_keep_shapes_and_dtypes() -> None:
    nothing = (np.zeros((0, 2), np.int32), np.zeros(0, np.float32))
    parts = [(np.full((n, 2), n, np.int32), np.full(n, n, np.float32)) for n in (2, 0, 1)]
    offsets, (pairs, values) = join_parts(parts, nothing)
    assert offsets.tolist() == [0, 2, 2, 3]
    assert pairs.tolist() == [[2, 2], [2, 2], [1, 1]] and values.tolist() == [2, 2, 1]
    offsets, columns = join_parts([], nothing)
    assert offsets.tolist() == [0] and offsets.dtype == np.int64
    assert [(part.shape, part.dtype) for part in columns] == [((0, 2), np.int32), ((0,), np.float32)]


def test_runs_start_where_any_column_changes() -> None:
    first, second = np.array([1, 1, 2, 2, 2]), np.array([7, 7, 7, 0, 0])
    assert starts_of(first, second).tolist() == [True, False, True, True, False]
    assert starts_of(first).tolist() == [True, False, True, False, False]
    assert starts_of(first[:0]).tolist() == []


@pytest.mark.parametrize("shape", [(), (3,), (3, 3)])
@pytest.mark.parametrize("rows", [0, 1, 5000])
def test_sums_are_those_of_adding_row_by_row_to_the_bit(shape: tuple[int, ...], rows: int) -> None:
    rng = np.random.default_rng(3)
    values, groups = rng.normal(size=(rows, *shape)), rng.integers(0, 70, rows)
    expected = np.zeros((80, *shape))
    np.add.at(expected, groups, values)
    np.testing.assert_array_equal(sum_by(values, groups, 80), expected)


def test_components_are_numbered_by_their_first_nodes() -> None:
    assert components_of(6, np.array([[5, 1], [4, 2], [2, 4], [3, 3]])).tolist() == [0, 1, 2, 3, 2, 1]
    assert components_of(2, np.zeros((0, 2))).tolist() == [0, 1]
    assert components_of(0, np.zeros((0, 2))).tolist() == []
    # a long chain in disorder, and a star around its last node
    order = np.random.default_rng(1).permutation(5000)
    assert not components_of(5000, np.column_stack([order[:-1], order[1:]])).any()
    star = components_of(5000, np.column_stack([np.arange(1, 4999), np.full(4998, 4999)]))
    assert star[0] == 0 and (star[1:] == 1).all()


@pytest.mark.parametrize("numbers", [1, 30, 3000])
def test_pairs_are_taken_one_to_one_as_if_one_by_one(numbers: int) -> None:
    pairs = np.random.default_rng(numbers).integers(0, numbers, (2000, 2))
    taken: tuple[set[int], set[int]] = (set(), set())
    expected = []
    for row, (first, second) in enumerate(pairs.tolist()):
        if first not in taken[0] and second not in taken[1]:
            taken[0].add(first)
            taken[1].add(second)
            expected.append(row)
    assert one_to_one(pairs).tolist() == expected
    assert one_to_one(pairs[:0]).tolist() == []
