"""Four lanes at once give what each would by itself."""

import numpy as np
import pytest
from numba.core.errors import TypingError

from slamcli.geometry.four import everywhere, lanes, load, where
from slamcli.jit.kernel import kernel

A = np.array([1.0 / 3.0, -0.0, np.inf, np.nan])
B = np.array([0.1, 0.0, 1e300, 1.0])
WHOLE = np.array([[1, 2, 2**64 - 1, 7], [1, 3, 2, 7]], dtype=np.uint64)


@kernel
def _doubles(rows, number):
    a, b = load(rows, 0), load(rows, 1)
    return lanes(a + b), lanes(where(a < b, a, b)), lanes(where(a <= b, a, b)), lanes(everywhere(number))


@kernel
def _wholes(rows, doubles):
    a, b = load(rows, 0), load(rows, 1)
    return lanes(a + b), lanes(where(a == b, everywhere(np.uint64(9)), a)), lanes(where(load(doubles, 0) < load(doubles, 1), a, b))


def test_doubles() -> None:
    total, less, not_more, same = _doubles(np.stack([A, B]), 0.1)
    np.testing.assert_array_equal(total, A + B)
    np.testing.assert_array_equal(less, np.where(A < B, A, B))  # false where a lane is not a number, as of single numbers
    np.testing.assert_array_equal(not_more, np.where(A <= B, A, B))
    assert np.signbit(less[1]) != np.signbit(not_more[1])  # -0 is not less than 0, and not more
    assert same == (0.1,) * 4


def test_whole_numbers_wrap_around_and_are_chosen_by_flags_of_doubles() -> None:
    total, chosen, by_doubles = _wholes(WHOLE, np.stack([A, B]))
    assert list(map(int, total)) == [2, 5, 1, 14]
    assert list(map(int, chosen)) == [9, 2, 2**64 - 1, 9]
    np.testing.assert_array_equal(by_doubles, np.where(A < B, *WHOLE))


def test_rows_may_begin_anywhere() -> None:
    for first in range(4):
        memory = np.arange(20.0)[first : first + 8].reshape(2, 4)
        assert _doubles(memory, 0.0)[0] == tuple(memory.sum(axis=0))


@pytest.mark.parametrize(
    "rows", [np.ones((2, 4), np.float32), np.ones((2, 4), order="F"), np.ones((1, 2, 4)), np.ones((2, 4), np.int64)]
)  # fmt: skip
def test_other_arrays_are_refused_before_they_are_read(rows: np.ndarray) -> None:
    with pytest.raises(TypingError):
        _doubles(rows, 0.0)


def test_what_is_not_of_one_kind_cannot_be_mixed() -> None:
    @kernel
    def mixed(doubles, wholes):
        return lanes(load(doubles, 0) + load(wholes, 0))

    with pytest.raises(TypingError):
        mixed(np.stack([A, B]), WHOLE)
