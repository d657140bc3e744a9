"""Rigid motions: laws of the group, and the series near zero and near a half turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.errors import SlamError
from slamcli.geometry import algebra, elementary, se3

directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda d: np.linalg.norm(d) > 0.1)
angles = st.one_of(st.floats(0.0, 1e-3), st.floats(0.0, 3.1), st.floats(3.1, np.pi - 1e-6))
positions = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


@st.composite
def twists(draw):
    direction = np.array(draw(directions))
    return np.concatenate([draw(positions), direction / np.linalg.norm(direction) * draw(angles)])


@given(twists())
def test_log_inverts_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=2e-7 if np.linalg.norm(xi[3:]) > 3.1 else 1e-9)


@given(twists(), twists())
def test_inverse_and_adjoint(a, b):
    T = se3.exp(a)
    np.testing.assert_allclose(T @ se3.inverse(T), np.eye(4), atol=1e-12)
    b = b * 0.1
    np.testing.assert_allclose(T @ se3.exp(b) @ se3.inverse(T), se3.exp(se3.adjoint(T) @ b), atol=1e-9)


@given(twists(), twists())
def test_left_update_is_exp_times(a, b):
    T = se3.exp(a)
    updated = T.copy()
    se3.left_update(updated, b)
    np.testing.assert_allclose(updated, se3.exp(b) @ T, atol=1e-12)


def test_exp_agrees_with_the_matrix_exponential():
    from scipy.linalg import expm

    for scale in (1e-9, 1e-4, 0.3, 3.0):
        xi = scale * np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
        np.testing.assert_allclose(se3.exp(xi), expm(generator), atol=1e-14)


@given(twists(), twists(), st.floats(0.0, 1.0))
def test_interpolation_meets_its_ends_and_moves_steadily(a, b, alpha):
    T_a, T_b = se3.exp(a), se3.exp(a) @ se3.exp(0.3 * b)
    np.testing.assert_allclose(se3.interpolate(T_a, T_b, 0.0), T_a, atol=1e-9)
    np.testing.assert_allclose(se3.interpolate(T_a, T_b, 1.0), T_b, atol=1e-9)
    T_m = se3.interpolate(T_a, T_b, alpha)
    np.testing.assert_allclose(se3.log(se3.inverse(T_a) @ T_m), alpha * 0.3 * b, atol=1e-8)


def test_quaternions_round_trip_in_stacks():
    rng = np.random.default_rng(0)
    T = se3.exp(rng.normal(size=(5, 2, 6)))
    again = se3.from_quaternion(T[..., :3, 3], 3.0 * se3.quaternion_xyzw(T))
    np.testing.assert_allclose(again, T, atol=1e-12)


@given(twists(), st.floats(0.5, 2.0))
def test_umeyama_recovers_a_similarity(xi, scale):
    x_a = np.random.default_rng(1).normal(size=(20, 3))
    T_ba = se3.exp(xi)
    x_b = scale * x_a @ T_ba[:3, :3].T + T_ba[:3, 3]
    found, found_scale = se3.umeyama(x_a, x_b, with_scale=True)
    np.testing.assert_allclose(found, T_ba, atol=1e-8)
    assert found_scale == pytest.approx(scale)


def test_umeyama_never_mirrors():
    x = np.random.default_rng(2).normal(size=(10, 3))
    T, _ = se3.umeyama(x, x * [1.0, 1.0, -1.0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.outer(np.arange(5.0), [1.0, 2.0, 3.0])], ids=["two", "a line"])
def test_umeyama_refuses_what_is_undetermined(points):
    with pytest.raises(SlamError, match="alignment"):
        se3.umeyama(points, points)


def test_arrays_mapped_from_files_need_no_kernel_of_their_own():
    """They are read-only, for which numba would compile every kernel again at its first call."""
    T, xi, x = se3.exp(np.full((3, 6), 0.1)), np.full((3, 6), 0.1), np.ones((5, 3))
    for array in (T, xi, x):
        array.flags.writeable = False
    kernels = (se3._invert, se3._transform, se3._exp, se3._log, algebra._multiply, algebra._nearest_rotations, elementary._sines)
    for f in (se3.inverse, se3.log, se3.orthonormalize, algebra.eigh, algebra.inverse):
        f(T)
    se3.exp(xi)
    se3.transform(T[0], x)
    algebra.product(T, T[0])
    elementary.sin(x)
    assert [len(kernel.signatures) for kernel in kernels] == [1] * len(kernels)
