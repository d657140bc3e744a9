"""Sine, exponential and their like with the same digits on every processor.

NumPy and the C library choose their code by the processor, and their last digits differ. Here every operation is rounded by itself. All are
within two units of the last place. Polynomials are those of FDLIBM, Sun Microsystems 1993, https://www.netlib.org/fdlibm

`sin`, `cos`, ... take and give arrays; kernels call `sine`, `cosine`, ... with numbers.
"""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from numba import float64 as f8

from slamcli.geometry.algebra import for_kernel
from slamcli.jit.kernel import kernel

HALF_PI_1, HALF_PI_2, HALF_PI_3 = 1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21  # their sum, 119 bits
LN2_1, LN2_2 = 6.93147180369123816490e-01, 1.90821492927058770002e-10
LARGEST_ANGLE = 1e5  # [rad] beyond it the reduction to a quarter turn loses digits


@kernel
def _quarter(x):
    """Return the number of the quarter turn, 0..3, and the rest of an angle, within pi / 4."""
    n = np.rint(x * (2.0 / np.pi))
    return int(n) & 3, ((x - n * HALF_PI_1) - n * HALF_PI_2) - n * HALF_PI_3


@kernel
def _sine_near_0(r):
    z = r * r
    p = z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))
    return r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + p)))


@kernel
def _cosine_near_0(r):
    z = r * r
    p = z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11))
    tail = z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + p)))
    half = 0.5 * z
    w = 1.0 - half
    return w + (((1.0 - w) - half) + tail)


@kernel
def sine(x):
    """Return the sine of an angle [rad]; NaN where it is larger than LARGEST_ANGLE."""
    if not abs(x) <= LARGEST_ANGLE:
        return np.nan
    quarter, r = _quarter(x)
    value = _cosine_near_0(r) if quarter & 1 else _sine_near_0(r)
    return -value if quarter & 2 else value


@kernel
def cosine(x):
    """Return the cosine of an angle [rad]; NaN where it is larger than LARGEST_ANGLE."""
    if not abs(x) <= LARGEST_ANGLE:
        return np.nan
    quarter, r = _quarter(x)
    value = _sine_near_0(r) if quarter & 1 else _cosine_near_0(r)
    return -value if quarter == 1 or quarter == 2 else value


@kernel(error_model="numpy")
def _arctangent(x):
    """Return the arc tangent of a number that is not negative."""
    if x < 0.4375:
        high, low = 0.0, 0.0
    elif x < 0.6875:
        high, low, x = 4.63647609000806093515e-01, 2.26987774529616870924e-17, (2.0 * x - 1.0) / (2.0 + x)
    elif x < 1.1875:
        high, low, x = 7.85398163397448278999e-01, 3.06161699786838301793e-17, (x - 1.0) / (x + 1.0)
    elif x < 2.4375:
        high, low, x = 9.82793723247329054082e-01, 1.39033110312309984516e-17, (x - 1.5) / (1.0 + 1.5 * x)
    else:
        high, low, x = 1.57079632679489655800, 6.12323399573676603587e-17, -1.0 / x
    z = x * x
    w = z * z
    odd = 4.97687799461593236017e-02 + w * 1.62858201153657823623e-02
    odd = 9.09088713343650656196e-02 + w * (6.66107313738753120669e-02 + w * odd)
    odd = z * (3.33333333333329318027e-01 + w * (1.42857142725034663711e-01 + w * odd))
    even = -5.83357013379057348645e-02 - w * 3.65315727442169155270e-02
    even = w * (-1.99999999998764832476e-01 + w * (-1.11111104054623557880e-01 + w * (-7.69187620504482999495e-02 + w * even)))
    return high - ((x * (odd + even) - low) - x)


@kernel(error_model="numpy")
def arctangent2(y, x):
    """Return the angle of the point (x, y) [rad], from -pi to pi; 0 or pi where both are 0."""
    if np.isnan(x) or np.isnan(y):
        return np.nan
    a, b = abs(y), abs(x)
    if a == 0.0 and b == 0.0:
        angle = 0.0
    elif np.isinf(a) and np.isinf(b):
        angle = 0.25 * np.pi
    else:
        angle = _arctangent(a / b)
    if np.copysign(1.0, x) < 0.0:
        angle = np.pi - (angle - 1.2246467991473531772e-16)
    return np.copysign(angle, y)


@kernel(error_model="numpy")
def arccosine(x):
    """Return the angle of a cosine [rad], NaN where it is outside -1 to 1."""
    return arctangent2(np.sqrt((1.0 - x) * (1.0 + x)), x) if abs(x) <= 1.0 else np.nan


@kernel
def exponential(x):
    """Return e to the x; inf beyond what a double can hold."""
    if np.isnan(x):
        return x
    if x > 709.782712893383973096:
        return np.inf
    if x < -745.13321910194110842:
        return 0.0
    n = np.rint(x * 1.44269504088896338700)
    high, low = x - n * LN2_1, n * LN2_2
    r = high - low
    z = r * r
    p = z * (6.61375632143793436117e-05 + z * (-1.65339022054652515390e-06 + z * 4.13813679705723846039e-08))
    c = r - z * (1.66666666666666019037e-01 + z * (-2.77777777770155933842e-03 + p))
    return math.ldexp(1.0 - ((low - (r * c) / (2.0 - c)) - high), int(n))


@kernel(error_model="numpy")
def logarithm(x):
    """Return the natural logarithm; -inf of 0, NaN below."""
    if not x > 0.0:
        return -np.inf if x == 0.0 else np.nan
    if np.isinf(x):
        return x
    m, k = math.frexp(x)
    if m < 0.70710678118654752440:
        m, k = 2.0 * m, k - 1
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    odd = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01))
    even = 2.857142874366239149e-01 + w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)
    even = z * (6.666666666666735130e-01 + w * even)
    half = 0.5 * f * f
    return k * LN2_1 - ((half - (s * (half + odd + even) + k * LN2_2)) - f)


@kernel(error_model="numpy")
def cube_root(x):
    """Return the real cube root."""
    a = abs(x)
    if a == 0.0 or not np.isfinite(a):
        return x
    root = exponential(logarithm(a) / 3.0)
    root -= (root * root * root - a) / (3.0 * root * root)
    return np.copysign(root, x)


@kernel
def whole_power(base, exponent):
    """Return a whole power, not negative, of a number by repeated multiplication."""
    value = 1.0
    for _ in range(exponent):
        value *= base
    return value


@kernel(error_model="numpy")
def _sines(x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = sine(x[i])


@kernel(error_model="numpy")
def _cosines(x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = cosine(x[i])


@kernel(error_model="numpy")
def _arccosines(x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = arccosine(x[i])


@kernel(error_model="numpy")
def _exponentials(x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = exponential(x[i])


@kernel(error_model="numpy")
def _logarithms(x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = logarithm(x[i])


@kernel(error_model="numpy")
def _cube_roots(x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = cube_root(x[i])


@kernel(error_model="numpy")
def _arctangents2(y: f8[::1], x: f8[::1], out: f8[::1]):
    for i in range(len(x)):
        out[i] = arctangent2(y[i], x[i])


def _each(kernel: Callable[..., None], *values: npt.ArrayLike) -> np.ndarray:
    arrays = np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in values)) if len(values) > 1 else values
    flat = [for_kernel(array).ravel() for array in arrays]
    out = np.empty(np.shape(arrays[0]))
    kernel(*flat, out.reshape(-1))
    return out[()]  # a number where it is one


def sin(x: npt.ArrayLike) -> np.ndarray:
    """Return the sines of angles (...) [rad], NaN where they are larger than LARGEST_ANGLE."""
    return _each(_sines, x)


def cos(x: npt.ArrayLike) -> np.ndarray:
    """Return the cosines of angles (...) [rad], NaN where they are larger than LARGEST_ANGLE."""
    return _each(_cosines, x)


def tan(x: npt.ArrayLike) -> np.ndarray:
    """Return the tangents of angles (...) [rad], NaN where they are larger than LARGEST_ANGLE."""
    return sin(x) / cos(x)


def arccos(x: npt.ArrayLike) -> np.ndarray:
    """Return the angles (...) [rad] of cosines, NaN where these are outside -1 to 1."""
    return _each(_arccosines, x)


def exp(x: npt.ArrayLike) -> np.ndarray:
    """Return e to the powers (...)."""
    return _each(_exponentials, x)


def log(x: npt.ArrayLike) -> np.ndarray:
    """Return the natural logarithms (...), -inf of 0, NaN below."""
    return _each(_logarithms, x)


def cbrt(x: npt.ArrayLike) -> np.ndarray:
    """Return the real cube roots (...)."""
    return _each(_cube_roots, x)


def arctan2(y: npt.ArrayLike, x: npt.ArrayLike) -> np.ndarray:
    """Return the angles (...) [rad] of points (x, y), from -pi to pi; 0 or pi where both are 0."""
    return _each(_arctangents2, y, x)


def power(base: float, exponent: np.ndarray) -> np.ndarray:
    """Return whole powers (...), not negative, of a number, as repeated multiplication gives them."""
    exponent = np.asarray(exponent, dtype=np.int64)
    return np.cumprod(np.append(1.0, np.full(int(exponent.max(initial=0)), base)))[exponent]
