"""Cholesky's method for symmetric systems of 6 x 6 blocks that lie in a band, in a fixed order of summation.

LAPACK, whose order depends on the processor, needs as long for up to 30 block rows, and half as long for 300. The upper triangle is held by rows:
entry (row, column) at ``row * stride + column`` of a flat array, with ``stride = reach`` for a band of which a row holds ``reach + 1``
entries, and ``stride = n`` for a dense matrix, whose reach is n - 1.

G. Golub, C. Van Loan, Matrix Computations, 2013, section 4.2.
"""

import numpy as np
from numba import float64 as f8
from numba import i8

from slamcli.jit.kernel import kernel

SIDE = 6  # of a block


@kernel(error_model="numpy")
def factorize(A: f8[::1], n: i8, stride: i8, reach: i8, panel: f8[:, ::1]):
    """Replace A = U^T U of n rows by U; False where A is not positive definite.

    reach : a block row ends so many entries after its first; panel : (6, n) work space
    """
    for first in range(0, n, SIDE):
        last, end = first + SIDE, min(n, first + reach + 1)
        for k in range(first, last):
            row = A[k * (stride + 1) : k * stride + end]
            if not row[0] > 0.0:
                return False
            row[0] = np.sqrt(row[0])
            scale = 1.0 / row[0]
            for c in range(1, len(row)):
                row[c] *= scale
            for r in range(k + 1, last):
                below, mine, factor = A[r * (stride + 1) : r * stride + end], row[r - k :], row[r - k]
                for c in range(len(below)):
                    below[c] -= factor * mine[c]
        m = end - last
        for k in range(SIDE):
            for c in range(m):
                panel[k, c] = A[(first + k) * stride + last + c]
        _subtract_panel(A, last * (stride + 1), stride + 1, m, panel)
    return True


@kernel(error_model="numpy")
def _subtract_panel(A, start, step, m, panel):
    """Subtract P^T P of the panel P (6, m) from the triangle whose diagonal begins at `start`; two rows at once halve what is read."""
    for r in range(0, m, 2):
        f0, f1, f2, f3, f4, f5 = panel[0, r], panel[1, r], panel[2, r], panel[3, r], panel[4, r], panel[5, r]
        g0, g1, g2, g3, g4, g5 = panel[0, r + 1], panel[1, r + 1], panel[2, r + 1], panel[3, r + 1], panel[4, r + 1], panel[5, r + 1]
        diagonal = start + r * step
        A[diagonal] = A[diagonal] - f0 * f0 - f1 * f1 - f2 * f2 - f3 * f3 - f4 * f4 - f5 * f5
        upper, lower = A[diagonal + 1 : diagonal + m - r], A[diagonal + step : diagonal + step + m - r - 1]
        p0, p1, p2 = panel[0, r + 1 : m], panel[1, r + 1 : m], panel[2, r + 1 : m]
        p3, p4, p5 = panel[3, r + 1 : m], panel[4, r + 1 : m], panel[5, r + 1 : m]
        for c in range(len(upper)):
            a0, a1, a2, a3, a4, a5 = p0[c], p1[c], p2[c], p3[c], p4[c], p5[c]
            upper[c] = upper[c] - f0 * a0 - f1 * a1 - f2 * a2 - f3 * a3 - f4 * a4 - f5 * a5
            lower[c] = lower[c] - g0 * a0 - g1 * a1 - g2 * a2 - g3 * a3 - g4 * a4 - g5 * a5


@kernel(error_model="numpy")
def solve(U: f8[::1], n: i8, stride: i8, reach: i8, x: f8[:, ::1]):
    """Replace each right-hand side, a row of x (M, n), by the solution of U^T U x = b, with U as `factorize` left it."""
    for m in range(len(x)):
        y = x[m]
        for k in range(n):
            row = _row(U, n, stride, reach, k)
            value = y[k] / row[0]
            y[k] = value
            rest = y[k + 1 : k + len(row)]
            for c in range(len(rest)):
                rest[c] -= row[1 + c] * value
        for k in range(n - 1, -1, -1):
            row = _row(U, n, stride, reach, k)
            y[k] = (y[k] - _dot(row[1:], y[k + 1 :])) / row[0]


@kernel
def _row(U, n, stride, reach, k):
    return U[k * (stride + 1) : k * stride + min(n, k - k % SIDE + reach + 1)]


@kernel
def _dot(a, b):
    """Sum the products of a (N,) and the first N of b in four interleaved sums: one would wait for each addition."""
    s0 = s1 = s2 = s3 = 0.0
    whole = len(a) - len(a) % 4
    for i in range(0, whole, 4):
        s0, s1 = s0 + a[i] * b[i], s1 + a[i + 1] * b[i + 1]
        s2, s3 = s2 + a[i + 2] * b[i + 2], s3 + a[i + 3] * b[i + 3]
    for i in range(whole, len(a)):
        s0 += a[i] * b[i]
    return (s0 + s1) + (s2 + s3)
