"""Alignment on shape: recovery, what is determined, coarse depth, hostile depth images."""

import numpy as np
import pytest
from boxroom import FURNITURE, look_along, render
from kinect import KINECT, noisy

from slamcli.config.options import SensorConfig
from slamcli.depth import icp, icp_kernels
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

SENSOR = SensorConfig()
HERE = look_along([2.0, 1.6, 1.0], 3.9, 0.3)  # into a corner
LENS = Camera(160, 120, 147.3, 152.3, 79.5, 59.5, k1=0.2312, k2=-0.7849, p1=-0.0033, p2=-0.0001, k3=0.9172)


def relief(T_lc: np.ndarray, seed: int | None = None, **scene) -> icp.OrientedPoints:
    depth = render(T_lc, KINECT, **scene)
    return icp.surface_points(icp.coarsen(depth if seed is None else noisy(depth, seed)), KINECT, SENSOR)


def error(found: icp.Alignment, T_li: np.ndarray, T_lj: np.ndarray) -> np.ndarray:
    return se3.log(found.T_ij @ se3.inverse(T_lj) @ T_li)


# --- recovery


@pytest.mark.parametrize("seed", [None, 1])
def test_a_known_motion_comes_back(seed):
    moved = HERE @ se3.exp(np.array([0.08, -0.03, 0.1, 0.03, 0.06, -0.02]))
    source, target = relief(HERE, seed), relief(moved, None if seed is None else seed + 1)
    found = icp.align(np.eye(4), source, target)
    e = error(found, moved, HERE)
    assert np.linalg.norm(e[:3]) < (0.002 if seed is None else 0.006) and np.linalg.norm(e[3:]) < 0.003
    assert found.overlap > 0.6 and found.agreement > 0.9
    assert icp.n_determined(found.information, found.depth) == 6
    back = icp.align(np.eye(4), target, source)
    np.testing.assert_allclose(back.T_ij @ found.T_ij, np.eye(4), atol=0.006)


def test_the_lens_is_taken_out():
    """The same surfaces through a lens that distorts: the ray of each raw pixel is what was rendered."""
    T = [HERE, HERE @ se3.exp(np.array([0.05, 0.02, 0.04, 0.01, 0.05, 0.01]))]
    v, u = np.mgrid[0:120, 0:160]
    ideal = LENS.undistort(np.stack([u, v], axis=-1).astype(float))
    fine = Camera(640, 480, 4 * LENS.fx, 4 * LENS.fy, 4 * LENS.cx, 4 * LENS.cy)
    at = np.rint(4 * ideal).astype(int).clip([0, 0], [639, 479])
    depth = [render(t, fine)[at[..., 1], at[..., 0]] for t in T]
    source, target = (icp.surface_points(icp.coarsen(d), LENS, SENSOR) for d in depth)
    e = error(icp.align(np.eye(4), source, target), T[1], T[0])
    assert np.linalg.norm(e[:3]) < 0.004 and np.linalg.norm(e[3:]) < 0.002


def test_what_is_known_besides_decides_where_shape_says_nothing():
    wall = {"boxes": (((3.0, -20.0, -20.0), (3.2, 20.0, 20.0)),), "room": None}
    T = [look_along([1.0, 0.0, 0.0], 0.0, 0.0), look_along([1.1, 0.2, 0.0], 0.0, 0.0)]
    source, target = (relief(t, s, **wall) for s, t in enumerate(T))
    true = se3.inverse(T[1]) @ T[0]
    free = icp.align(np.eye(4), source, target)
    tied = icp.align(np.eye(4), source, target, prior=icp.PosePrior(true, np.diag([1e6, 1e6, 0.0, 0.0, 0.0, 1e6])))
    assert abs(error(free, T[1], T[0])[0]) > 0.1
    assert np.abs(error(tied, T[1], T[0])).max() < 0.01


def test_same_input_same_bytes_and_the_input_stays():
    source, target, start = relief(HERE, 1), relief(HERE, 2), np.eye(4)
    a, b = icp.align(start, source, target), icp.align(start, source, target)
    assert a.T_ij.tobytes() == b.T_ij.tobytes() and a.information.tobytes() == b.information.tobytes()
    np.testing.assert_array_equal(start, np.eye(4))


# --- what is determined


FLAT = {"boxes": (((3.0, -20.0, -20.0), (3.2, 20.0, 20.0)),), "room": None}
CORRIDOR = {"boxes": (((-20.0, 1.0, -20.0), (20.0, 1.2, 20.0)), ((-20.0, -20.0, -1.0), (20.0, 20.0, -0.8))), "room": None}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("scene", "yaw", "pitch", "expected"),
    [(FLAT, 0.0, 0.0, 3), (FLAT, 0.4, 0.2, 3), (CORRIDOR, 0.9, 0.5, 5), ({"boxes": FURNITURE}, 3.9, 0.3, 6)],
    ids=["wall", "wall at an angle", "wall and floor", "corner"],
)
def test_directions_that_shape_determines_are_counted(scene, yaw, pitch, expected, seed):
    T = look_along([2.0, 1.6, 1.0] if expected == 6 else [0.5, 0.0, 0.2], yaw, pitch)
    found = icp.align(np.eye(4), relief(T, 10 + seed, **scene), relief(T, 20 + seed, **scene))
    sigma = icp.weakest_sigmas(found.information, found.depth)
    assert icp.n_determined(found.information, found.depth) == expected, sigma
    assert (np.diff(sigma) <= 0.0).all() and sigma[-1] > 0.0


def test_the_error_stays_within_what_the_information_says():
    chi2 = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T = HERE @ se3.exp(rng.normal(size=6) * [0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
        moved = T @ se3.exp(rng.normal(size=6) * 0.03)
        found = icp.align(np.eye(4), relief(T, 2 * seed), relief(moved, 2 * seed + 1))
        e = error(found, moved, T)
        chi2.append(e @ found.information @ e)
    assert 1e-3 < np.mean(chi2) < 12.0  # 6 were each reading independent; real sensors err together over far more than simulated ones


def test_iterations_are_counted_and_end_where_steps_are_short(monkeypatch):
    moved = HERE @ se3.exp(np.array([0.08, -0.03, 0.1, 0.03, 0.06, -0.02]))
    source, target = relief(HERE, 1), relief(moved, 2)
    found = icp.align(np.eye(4), source, target)
    again = icp.align(found.T_ij, source, target)
    assert again.is_converged
    assert len(icp.SCHEDULE) <= again.iterations < found.iterations <= icp.SCHEDULE[:, 2].sum()
    monkeypatch.setattr(icp, "SCHEDULE", np.array([icp.Pass(8, 0.3, 1, 1e-9)]))
    cut_short = icp.align(np.eye(4), source, target)
    assert cut_short.iterations == 1 and not cut_short.is_converged


def test_equations_that_have_no_solution_are_no_convergence():
    source, target, T = relief(HERE, 1), relief(HERE, 2), se3.exp(np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0]))
    nothing, found = (icp_kernels.PoseEquations(np.zeros((6, 6)), np.zeros(6)) for _ in range(2))
    met, _, _, iterations, is_converged = icp_kernels.align(
        T.copy(), source.points, target.points, target.view, icp.SCHEDULE, icp.RULE, nothing, found
    )
    assert met == 0 and iterations == len(icp.SCHEDULE) and not is_converged


def test_places_that_differ_do_not_agree():
    there = look_along([5.5, 2.0, 1.0], 0.3, 0.1)
    found = icp.align(np.eye(4), relief(HERE, 1), relief(there, 2))
    assert found.agreement < 0.6 or found.overlap < 0.3


# --- the kernel


def test_the_gradient_equals_numerical_derivatives():
    """Of the pairs that a slow twin finds, where nothing may move; and the information is what both normals of each pair say."""
    source, target = relief(HERE, 3), relief(HERE, 4)
    T = se3.exp(np.array([0.004, -0.003, 0.005, 0.002, -0.001, 0.002]))
    H, b, still = np.zeros((6, 6)), np.zeros(6), np.array([[1.0, 0.05, 1.0, 1.0]])
    rule, held = icp_kernels.AgreementRule(0.8, np.inf, 1.0), icp_kernels.PoseEquations(1e20 * np.eye(6), np.zeros(6))
    found = icp_kernels.PoseEquations(H, b)
    met, agree, cost, iterations, _ = icp_kernels.align(T.copy(), source.points, target.points, target.view, still, rule, held, found)

    q = se3.transform(T, source.xyz.astype(float))
    fx, fy, cx, cy = target.pinhole
    u, v = (np.floor(f * q[:, a] / q[:, 2] + c + 0.5).astype(int) for a, f, c in ((0, fx, cx), (1, fy, cy)))
    inside = (u >= 0) & (v >= 0) & (u < target.row.shape[1]) & (v < target.row.shape[0])
    i = np.where(inside, target.row[v.clip(0, target.row.shape[0] - 1), u.clip(0, target.row.shape[1] - 1)], -1)
    j = np.flatnonzero(i >= 0)
    assert met == len(j) and iterations == 1
    m = source.normal @ T[:3, :3].T
    close = (np.linalg.norm(q[j] - target.xyz[i[j]], axis=1) <= 0.05) & ((m[j] * target.normal[i[j]]).sum(axis=1) >= 0.8)
    j = j[close]
    assert agree == len(j) > 5000
    sigma = np.sqrt(source.variance[j] + target.variance[i[j]])

    def residual(xi: np.ndarray) -> np.ndarray:
        return ((se3.transform(se3.exp(xi), q[j]) - target.xyz[i[j]]) * target.normal[i[j]]).sum(axis=1) / sigma

    r, step = residual(np.zeros(6)), 1e-5
    J = np.stack([(residual(step * axis) - residual(-step * axis)) / (2.0 * step) for axis in np.eye(6)], axis=1)
    np.testing.assert_allclose(cost, r @ r, rtol=1e-4)
    np.testing.assert_allclose(b, -J.T @ r, rtol=1e-3, atol=1e-4 * np.abs(b).max())
    M = np.hstack([m[j], np.cross(q[j], m[j])]) / sigma[:, None]
    expected = 0.5 * (J.T @ M + M.T @ J)
    np.testing.assert_allclose(np.triu(H), np.triu(expected), rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_coarse_depth_is_the_mean_of_what_is_nearest():
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 1.0
    depth[0:40, 0:40] = np.nan
    depth[100:104, 100:104] = np.nan
    depth[101, 101:103] = 1.5  # two of the four in the middle of a block: not enough
    coarse = icp.coarsen(depth)
    assert coarse.shape == icp.coarse_shape(camera) == (120, 160)
    np.testing.assert_allclose(coarse[50, [20, 79, 80, 150]] * icp.UNIT, [2.0, 2.0, 1.0, 1.0], atol=1e-4)
    assert (coarse[:10, :10] == 0).all() and coarse[25, 25] == 0


# --- hostile depth


@pytest.mark.parametrize(
    "depth",
    [
        np.zeros((120, 160)),
        np.full((120, 160), np.nan),
        np.full((120, 160), np.inf),
        np.full((120, 160), -1.0),
        np.full((120, 160), 1e6),
        np.random.default_rng(0).uniform(0.5, 5.0, (120, 160)),
    ],
    ids=["zeros", "NaN", "infinite", "negative", "far", "noise"],
)
def test_depth_that_shows_nothing_determines_nothing(depth):
    coarse = icp.coarsen(depth.astype(np.float32))
    empty = icp.surface_points(coarse, KINECT, SENSOR)
    for source, target in ((empty, relief(HERE)), (relief(HERE), empty), (empty, empty)):
        found = icp.align(np.eye(4), source, target)
        assert np.isfinite(found.T_ij).all() and found.overlap < 0.2
        assert icp.n_determined(found.information, found.depth) < 6 or found.agreement < 0.6


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (48, 64)])
def test_images_of_any_size_are_taken(size):
    height, width = size
    camera = Camera(width, height, float(width), float(width), (width - 1) / 2, (height - 1) / 2)
    found = icp.surface_points(icp.coarsen(np.full(size, 1.5, np.float32)), camera, SENSOR)
    assert found.row.shape == icp.coarse_shape(camera) and (found.row < len(found)).all()
    icp.align(np.eye(4), found, found)
