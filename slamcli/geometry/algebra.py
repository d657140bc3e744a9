"""Products, solutions and eigenvectors of matrices with the same digits on every processor.

BLAS and LAPACK choose their code by the processor: sums run in another order, and products are fused with sums where the processor can.
Here a sum runs in the order of its index and every operation is rounded by itself.
"""

import numpy as np
import numpy.typing as npt
from numba import float64 as f8

from slamcli.jit.kernel import kernel

DIAGONAL = 1e-40  # of the sum of all squares, that a matrix counts as diagonal with beside its diagonal
MAX_SWEEPS = 30  # of Jacobi's method, which converges quadratically: 6 to 10 are needed


def for_kernel(a: npt.ArrayLike) -> np.ndarray:
    """Return an array as kernels are compiled for: float64, in C's order, writable, which arrays mapped from files are not."""
    a = np.ascontiguousarray(a, dtype=np.float64)
    return a if a.flags.writeable else a.copy()


def product(*factors: np.ndarray) -> np.ndarray:
    """Multiply matrices from the left to the right; stacks and vectors are treated as by ``@``, the result is float64."""
    out = factors[0]
    for factor in factors[1:]:
        out = _product(np.asarray(out, dtype=np.float64), np.asarray(factor, dtype=np.float64))
    return out[()]  # a number where it is one


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if b.ndim == 1:
        return _product(a, b[:, None])[..., 0]
    if a.ndim == 1:
        return _product(a[None], b)[..., 0, :]
    if a.shape[-1] != b.shape[-2]:
        raise ValueError(f"shapes {a.shape} and {b.shape} do not match")
    stack = a.shape[:-2] if b.ndim == 2 else np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    out = np.empty((*stack, a.shape[-2], b.shape[-1]))
    flat = out.reshape(-1, *out.shape[-2:]) if stack else out[None]
    if out.size:
        _multiply(_flat(a, stack), _flat(b, stack), flat)
    return out


def _flat(a: np.ndarray, stack: tuple[int, ...]) -> np.ndarray:
    """Return the matrices as (1, m, n), where all are the same, or (N, m, n)."""
    if a.ndim == 2:
        return for_kernel(a)[None]
    if a.shape[:-2] != stack:
        a = np.broadcast_to(a, (*stack, *a.shape[-2:]))
    return for_kernel(a).reshape(-1, *a.shape[-2:])


@kernel
def _multiply(a: f8[:, :, ::1], b: f8[:, :, ::1], out: f8[:, :, ::1]):
    size = a.shape[2]
    for s in range(len(out)):
        s_a, s_b = s if len(a) > 1 else 0, s if len(b) > 1 else 0
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                if size == 3:  # written out for points: four times as fast
                    total = a[s_a, i, 0] * b[s_b, 0, j] + a[s_a, i, 1] * b[s_b, 1, j] + a[s_a, i, 2] * b[s_b, 2, j]
                else:
                    total = 0.0
                    for k in range(size):
                        total += a[s_a, i, k] * b[s_b, k, j]
                out[s, i, j] = total


def solve(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solve A x = b for stacks A (..., n, n), b (..., n, m), or (n,) for one matrix; NaN where A is singular.

    By elimination with partial pivoting: G. Golub, C. Van Loan, Matrix Computations, 2013, section 3.4.
    """
    A, b = np.asarray(A, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if b.ndim == 1:
        return solve(A, b[:, None])[:, 0]
    work = np.array(A, order="C").reshape(-1, *A.shape[-2:])
    out = np.array(np.broadcast_to(b, (*A.shape[:-1], b.shape[-1])), order="C")
    if out.size:
        _eliminate(work, out.reshape(-1, *out.shape[-2:]))
    return out


def inverse(A: np.ndarray) -> np.ndarray:
    """Invert matrices (..., n, n); NaN where they are singular."""
    return solve(A, np.eye(np.shape(A)[-1]))


@kernel(error_model="numpy")
def _eliminate(A: f8[:, :, ::1], b: f8[:, :, ::1]):
    """Replace b by the solution of A x = b, with A as work space."""
    n, m = A.shape[1], b.shape[2]
    for s in range(len(A)):
        for k in range(n):
            pivot = k
            for i in range(k + 1, n):
                if abs(A[s, i, k]) > abs(A[s, pivot, k]):
                    pivot = i
            if not abs(A[s, pivot, k]) > 0.0:
                b[s] = np.nan
                break
            if pivot != k:
                for j in range(k, n):
                    A[s, k, j], A[s, pivot, j] = A[s, pivot, j], A[s, k, j]
                for j in range(m):
                    b[s, k, j], b[s, pivot, j] = b[s, pivot, j], b[s, k, j]
            for i in range(k + 1, n):
                factor = A[s, i, k] / A[s, k, k]
                for j in range(k + 1, n):
                    A[s, i, j] -= factor * A[s, k, j]
                for j in range(m):
                    b[s, i, j] -= factor * b[s, k, j]
        else:
            for i in range(n - 1, -1, -1):
                for k in range(i + 1, n):
                    for j in range(m):
                        b[s, i, j] -= A[s, i, k] * b[s, k, j]
                for j in range(m):
                    b[s, i, j] /= A[s, i, i]


def eigh(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the eigenvalues (..., n), ascending, and orthonormal eigenvectors, columns of (..., n, n), of symmetric A (..., n, n).

    By Jacobi's method: G. Golub, C. Van Loan, Matrix Computations, 2013, section 8.5. NaN where a value of A is not finite.
    """
    A = np.asarray(A, dtype=np.float64)
    work = np.array(A, order="C").reshape(-1, *A.shape[-2:])
    value, vector = np.empty(work.shape[:2]), np.empty(work.shape)
    if work.size:
        _diagonalize(work, value, vector)
    return value.reshape(A.shape[:-1]), vector.reshape(A.shape)


@kernel(error_model="numpy")
def _diagonalize(A: f8[:, :, ::1], value: f8[:, ::1], vector: f8[:, :, ::1]):
    for s in range(len(A)):
        jacobi(A[s], value[s], vector[s])


@kernel(error_model="numpy")
def jacobi(A, value, vector):
    """Write the ascending eigenvalues (n,) and the eigenvectors, columns of (n, n), of symmetric A (n, n), which becomes diagonal."""
    n = len(A)
    for i in range(n):
        for j in range(n):
            vector[i, j] = 1.0 if i == j else 0.0
    for _ in range(MAX_SWEEPS):
        outside, all_squares = 0.0, 0.0
        for i in range(n):
            for j in range(n):
                square = A[i, j] * A[i, j]
                all_squares += square
                if i != j:
                    outside += square
        if not np.isfinite(all_squares):
            value[:] = np.nan
            vector[:] = np.nan
            return
        if outside <= DIAGONAL * all_squares:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                _rotate(A, vector, p, q)
    for i in range(n):
        value[i] = A[i, i]
    for i in range(n - 1):
        least = i
        for j in range(i + 1, n):
            if value[j] < value[least]:
                least = j
        if least != i:
            value[i], value[least] = value[least], value[i]
            for k in range(n):
                vector[k, i], vector[k, least] = vector[k, least], vector[k, i]


@kernel(error_model="numpy")
def _rotate(A, vector, p, q):
    """Turn rows and columns p, q of A so that A[p, q] vanishes, and columns p, q of the eigenvectors with them."""
    n, off = len(A), A[p, q]
    if off == 0.0:
        return
    theta = (A[q, q] - A[p, p]) / (2.0 * off)
    t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
    t = -t if theta < 0.0 else t
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    for k in range(n):
        a_p, a_q = A[k, p], A[k, q]
        A[k, p], A[k, q] = c * a_p - s * a_q, s * a_p + c * a_q
    for k in range(n):
        a_p, a_q = A[p, k], A[q, k]
        A[p, k], A[q, k] = c * a_p - s * a_q, s * a_p + c * a_q
    A[p, q] = A[q, p] = 0.0
    for k in range(n):
        v_p, v_q = vector[k, p], vector[k, q]
        vector[k, p], vector[k, q] = c * v_p - s * v_q, s * v_p + c * v_q


def pseudo_inverse(A: np.ndarray, *, rcond: float = 1e-15) -> np.ndarray:
    """Invert symmetric matrices (..., n, n) on the eigenvectors whose eigenvalues exceed the share `rcond` of the largest."""
    value, vector = eigh(A)
    size = np.abs(value)
    is_used = size > rcond * size.max(axis=-1, keepdims=True, initial=0.0)
    weight = np.where(is_used, 1.0 / np.where(is_used, value, 1.0), 0.0)
    return product(vector * weight[..., None, :], np.swapaxes(vector, -1, -2))


def nearest_rotation(M: np.ndarray) -> np.ndarray:
    """Return the rotations (..., 3, 3) that maximize trace(R^T M), the nearest ones to M (..., 3, 3).

    B. Horn, Closed-form solution of absolute orientation using unit quaternions, JOSA A 1987, doi:10.1364/JOSAA.4.000629
    """
    M = np.asarray(M, dtype=np.float64)
    out = np.empty(M.shape)
    if out.size:
        _nearest_rotations(for_kernel(M).reshape(-1, 3, 3), out.reshape(-1, 3, 3))
    return out


@kernel(error_model="numpy")
def _nearest_rotations(M: f8[:, :, ::1], R: f8[:, :, ::1]):
    form, value, vector = np.empty((4, 4)), np.empty(4), np.empty((4, 4))
    for s in range(len(M)):
        m = M[s]
        form[0, 0], form[1, 1] = m[0, 0] + m[1, 1] + m[2, 2], m[0, 0] - m[1, 1] - m[2, 2]
        form[2, 2], form[3, 3] = m[1, 1] - m[0, 0] - m[2, 2], m[2, 2] - m[0, 0] - m[1, 1]
        form[0, 1] = form[1, 0] = m[2, 1] - m[1, 2]
        form[0, 2] = form[2, 0] = m[0, 2] - m[2, 0]
        form[0, 3] = form[3, 0] = m[1, 0] - m[0, 1]
        form[1, 2] = form[2, 1] = m[1, 0] + m[0, 1]
        form[1, 3] = form[3, 1] = m[0, 2] + m[2, 0]
        form[2, 3] = form[3, 2] = m[2, 1] + m[1, 2]
        jacobi(form, value, vector)
        w, x, y, z = vector[0, 3], vector[1, 3], vector[2, 3], vector[3, 3]
        scale = 2.0 / (w * w + x * x + y * y + z * z)
        R[s, 0, 0], R[s, 0, 1], R[s, 0, 2] = 1.0 - scale * (y * y + z * z), scale * (x * y - w * z), scale * (x * z + w * y)
        R[s, 1, 0], R[s, 1, 1], R[s, 1, 2] = scale * (x * y + w * z), 1.0 - scale * (x * x + z * z), scale * (y * z - w * x)
        R[s, 2, 0], R[s, 2, 1], R[s, 2, 2] = scale * (x * z - w * y), scale * (y * z + w * x), 1.0 - scale * (x * x + y * y)
