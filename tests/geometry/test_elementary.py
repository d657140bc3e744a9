"""Own elementary functions within two units of the last place of NumPy's, and the same where NumPy's are exact by definition."""

import numpy as np
import pytest

from slamcli.geometry import elementary

SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan])
MOST_UNITS = 2.0


def units(found: np.ndarray, exact: np.ndarray) -> float:
    """The largest difference in units of the last place."""
    return float(np.max(np.abs(found - exact) / np.spacing(np.abs(exact))))


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("sin", -10, 10), ("cos", -10, 10), ("sin", -1e5, 1e5), ("cos", -1e5, 1e5), ("sin", -1e-8, 1e-8), ("arccos", -1, 1)]
    + [("exp", -700, 700), ("exp", -1e-9, 1e-9), ("log", 1e-300, 1e-290), ("log", 0.5, 2), ("log", 1, 1e300)]
    + [("cbrt", -1e9, 1e9), ("cbrt", -1e-300, 1e-300)],
)
def test_a_function_is_within_two_units_of_the_last_place(name: str, low: float, high: float) -> None:
    x = np.random.default_rng(3).uniform(low, high, size=50_000)
    found, exact = getattr(elementary, name)(x), getattr(np, name)(x)
    assert units(found, exact) <= MOST_UNITS
    assert (found != exact).mean() < 0.4  # and mostly it is the nearest number


def test_an_angle_is_that_of_numpy_in_every_direction() -> None:
    rng = np.random.default_rng(4)
    y, x = rng.normal(size=(2, 50_000)) * np.exp(rng.uniform(-20, 20, size=(2, 50_000)))
    assert units(elementary.arctan2(y, x), np.arctan2(y, x)) <= MOST_UNITS
    y, x = np.meshgrid(SPECIAL, SPECIAL)
    np.testing.assert_allclose(elementary.arctan2(y, x), np.arctan2(y, x), rtol=1e-15)
    is_number = ~(np.isnan(x) | np.isnan(y))
    np.testing.assert_array_equal(np.signbit(elementary.arctan2(y, x))[is_number], np.signbit(np.arctan2(y, x))[is_number])


@pytest.mark.parametrize("name", ["exp", "log", "cbrt", "arccos"])
def test_limits_and_what_is_not_a_number(name: str) -> None:
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(getattr(elementary, name)(SPECIAL), getattr(np, name)(SPECIAL), rtol=1e-15)


def test_an_angle_too_large_to_be_reduced_has_no_sine() -> None:
    assert np.isnan(elementary.sin([1e6, -np.inf, np.nan])).all()
    assert np.isnan(elementary.cos([1e6, np.inf, np.nan])).all()


def test_numbers_stay_numbers_and_arrays_keep_their_shape() -> None:
    assert float(elementary.sin(0.5)) == pytest.approx(np.sin(0.5))
    assert elementary.exp(np.zeros((2, 0, 3))).shape == (2, 0, 3)
    assert elementary.arctan2(np.ones((2, 3)), 1.0).shape == (2, 3)
    assert elementary.tan(0.25) == pytest.approx(np.tan(0.25), rel=1e-15)


def test_whole_powers_are_repeated_products() -> None:
    np.testing.assert_array_equal(elementary.power(1.2, np.array([[0, 1], [3, 2]])), [[1.0, 1.2], [1.2 * 1.2 * 1.2, 1.2 * 1.2]])
    assert elementary.power(2.0, np.zeros(0, dtype=int)).shape == (0,)
    assert elementary.whole_power.py_func(1.2, 3) == elementary.power(1.2, np.array(3))
