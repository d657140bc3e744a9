"""Products, solutions and eigenvectors against LAPACK's, and where they differ in law: singular, not finite, empty."""

import naive
import numpy as np
import pytest

from slamcli.geometry import algebra, banded_cholesky


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.mark.parametrize(
    ("shape_a", "shape_b"),
    [((4, 4), (4, 4)), ((5, 3), (3, 3)), ((7, 4, 4), (4, 4)), ((4, 4), (7, 4, 4)), ((7, 6, 6), (7, 6, 6)), ((3, 1, 2, 4), (5, 4, 3))]
    + [((4,), (4, 2)), ((2, 4), (4,)), ((9, 2, 3), (3,)), ((6,), (6,)), ((0, 4, 4), (4, 4)), ((2, 0), (0, 3)), ((3, 4, 4), (1, 4, 4))],
)
def test_a_product_is_that_of_numpy_for_every_shape(rng: np.random.Generator, shape_a: tuple, shape_b: tuple) -> None:
    a, b = rng.normal(size=shape_a), rng.normal(size=shape_b)
    found = algebra.product(a, b)
    assert np.shape(found) == (a @ b).shape
    np.testing.assert_allclose(found, a @ b, rtol=1e-13, atol=1e-13)


def test_a_product_of_several_goes_from_the_left_and_takes_views_and_whole_numbers(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(4, 4)), np.arange(16).reshape(4, 4)
    np.testing.assert_array_equal(algebra.product(a.T, b[::-1], a), algebra.product(algebra.product(a.T, b[::-1]), a))
    with pytest.raises(ValueError, match="do not match"):
        algebra.product(a, np.ones((3, 3)))


def test_a_product_sums_in_the_order_of_the_index(rng: np.random.Generator) -> None:
    for size in (3, 4, 17):
        a, b = rng.normal(size=(2, size)), rng.normal(size=(size, 2))
        np.testing.assert_array_equal(algebra.product(a, b), naive.product(a, b))


def test_solutions_and_inverses_fulfil_their_equations_and_are_nan_where_there_is_none(rng: np.random.Generator) -> None:
    A, b = rng.normal(size=(20, 6, 6)), rng.normal(size=(20, 6, 2))
    A[3, 0, 0] = 0.0  # needs another pivot
    np.testing.assert_allclose(A @ algebra.solve(A, b), b, atol=1e-11)
    np.testing.assert_allclose(algebra.inverse(A), np.linalg.inv(A), atol=1e-10)
    np.testing.assert_allclose(algebra.solve(A[0], b[0, :, 0]), np.linalg.solve(A[0], b[0, :, 0]), atol=1e-11)
    A[5] = 0.0
    assert np.isnan(algebra.inverse(A)[5]).all()
    assert np.isfinite(np.delete(algebra.inverse(A), 5, axis=0)).all()


@pytest.mark.parametrize("n", [1, 3, 4, 6, 12])
def test_eigenvectors_are_orthonormal_and_build_the_matrix_again(rng: np.random.Generator, n: int) -> None:
    M = rng.normal(size=(10, n, n))
    A = M + np.swapaxes(M, 1, 2)
    A[1], A[2] = np.eye(n), np.diag(np.arange(n)[::-1])  # equal eigenvalues; already diagonal, in falling order
    value, vector = algebra.eigh(A)
    np.testing.assert_allclose(value, np.linalg.eigvalsh(A), atol=1e-12)
    np.testing.assert_allclose(np.swapaxes(vector, 1, 2) @ vector, np.broadcast_to(np.eye(n), A.shape), atol=1e-13)
    np.testing.assert_allclose(vector @ (value[..., None] * np.swapaxes(vector, 1, 2)), A, atol=1e-12)


def test_small_eigenvalues_beside_large_ones_keep_their_digits() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    value, _ = algebra.eigh(turn @ np.diag([1e-9, 1.0]) @ turn.T)
    assert value[0] == pytest.approx(1e-9, rel=1e-6)


def test_eigenvalues_of_what_is_not_finite_are_nan() -> None:
    A = np.stack([np.eye(3), np.full((3, 3), np.nan), np.full((3, 3), np.inf)])
    value, _ = algebra.eigh(A)
    assert np.isnan(value[1:]).all()
    np.testing.assert_array_equal(value[0], 1.0)


def test_a_pseudo_inverse_leaves_out_what_is_undetermined(rng: np.random.Generator) -> None:
    J = rng.normal(size=(4, 6))
    A = np.stack([J.T @ J, np.eye(6), np.zeros((6, 6))])
    np.testing.assert_allclose(algebra.pseudo_inverse(A, rcond=1e-12), np.linalg.pinv(A, rcond=1e-12, hermitian=True), atol=1e-9)


def test_the_nearest_rotation_is_that_of_the_singular_values(rng: np.random.Generator) -> None:
    M = rng.normal(size=(50, 3, 3))
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
    found = algebra.nearest_rotation(M)
    np.testing.assert_allclose(found, U @ Vt, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-14)
    np.testing.assert_allclose(algebra.nearest_rotation(found), found, atol=1e-14)


@pytest.mark.parametrize(("n", "reach"), [(6, 5), (30, 29), (60, 59), (120, 23), (60, 11)])
def test_a_banded_factor_is_that_of_lapack_and_solves_the_system(rng: np.random.Generator, n: int, reach: int) -> None:
    blocks = (reach + 1) // 6
    A = sum(np.diag(rng.normal(size=n - d), d) for d in range(6 * blocks))
    row, column = np.indices((n, n)) // 6
    A = np.where((column >= row) & (column - row < blocks), np.triu(A), 0.0)
    A = A + A.T + 10.0 * n * np.eye(n)
    for stride in {reach, n}:
        flat = np.zeros(n * stride + n)
        for r in range(n):
            last = n if stride == n else min(n, r - r % 6 + reach + 1)
            flat[r * (stride + 1) : r * stride + last] = A[r, r:last]
        assert banded_cholesky.factorize(flat, n, stride, n - 1 if stride == n else reach, np.empty((6, n)))
        if stride == n:
            np.testing.assert_allclose(np.triu(flat[: n * n].reshape(n, n)), np.linalg.cholesky(A).T, atol=1e-12)
        b = rng.normal(size=(3, n))
        x = b.copy()
        banded_cholesky.solve(flat, n, stride, n - 1 if stride == n else reach, x)
        np.testing.assert_allclose(x @ A, b, atol=1e-11)


def test_a_matrix_that_is_not_positive_definite_has_no_factor(rng: np.random.Generator) -> None:
    for broken in (0.0, -1.0, np.nan):
        A = 10.0 * np.eye(12)
        A[7, 7] = broken
        assert not banded_cholesky.factorize(np.append(A.ravel(), np.zeros(12)), 12, 12, 11, np.empty((6, 12)))
