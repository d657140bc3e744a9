"""Six doubles at once give what loops over them give, digit by digit."""

import numpy as np
import pytest
from numba.core.errors import TypingError

from slamcli.geometry import six as six_module
from slamcli.geometry.six import load, screw, six, store
from slamcli.jit.kernel import kernel

AWKWARD = np.array([[1.0 / 3.0, -0.0, 1e300, 5e-324, np.inf, 0.1], [0.7, 0.0, -1e300, 3e-310, 1.0, -1e17]])


@kernel
def _combined(rows, number, out):
    a, b = load(rows, 0), load(rows, 1)
    store(out, 0, a + b)
    store(out, 1, a - b)
    store(out, 2, number * a)
    store(out, 3, a - (number * b + a))
    store(out, 4, six(number, 1.0, 2.0, 3.0, 4.0, 5.0))


@kernel
def _accumulated(rows, weights, out):
    total = six(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(len(rows)):
        total = total + weights[k] * load(rows, k)
    store(out, 0, total)


@kernel
def _screw(p, g, out):
    store(out, 0, screw(p[0], p[1], p[2], g[0], g[1], g[2]))


def test_each_lane_is_rounded_as_a_number_by_itself() -> None:
    number, out = 0.1, np.empty((5, 6))
    _combined(AWKWARD, number, out)
    a, b = AWKWARD
    with np.errstate(invalid="ignore"):
        expected = a + b, a - b, number * a, a - (number * b + a), [number, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert out.tobytes() == np.array(expected).tobytes()


def test_a_number_of_single_precision_is_taken_as_it_is() -> None:
    out = np.empty((5, 6))
    _combined(AWKWARD, np.float32(0.1), out)
    np.testing.assert_array_equal(out[2], np.float64(np.float32(0.1)) * AWKWARD[0])


def test_sums_have_the_order_of_the_loop() -> None:
    rng = np.random.default_rng(0)
    rows, weights, out = rng.normal(size=(1000, 6)), rng.normal(size=1000), np.empty((1, 6))
    _accumulated(rows, weights, out)
    expected = np.zeros(6)
    for row, weight in zip(rows, weights, strict=True):
        expected += weight * row
    assert out[0].tobytes() == expected.tobytes()


def test_rows_are_written_where_they_belong_and_nothing_beside_them() -> None:
    """Also where an array begins at no multiple of the width of a vector."""
    for start in range(4):
        memory = np.full(40, 7.0)
        rows = memory[start : start + 30].reshape(5, 6)
        _combined(AWKWARD, 0.5, rows)
        assert (memory[:start] == 7.0).all() and (memory[start + 30 :] == 7.0).all()


@pytest.mark.parametrize(
    "rows", [np.ones((2, 6), np.float32), np.asfortranarray(AWKWARD), AWKWARD[None]], ids=["single", "by columns", "three axes"]
)
def test_other_arrays_are_refused_before_they_are_read(rows: np.ndarray) -> None:
    with pytest.raises(TypingError):
        _accumulated(rows, np.ones(2), np.empty((1, 6)))


def test_a_screw_is_the_derivative_by_a_left_twist() -> None:
    rng = np.random.default_rng(1)
    p, g, out = rng.normal(size=3), rng.normal(size=3), np.empty((1, six_module.LANES))
    _screw(p, g, out)
    np.testing.assert_allclose(out[0], np.concatenate([g, np.cross(p, g)]), rtol=1e-15)
