"""Minimal solvers, RANSAC and motion-only refinement."""

import naive
import numpy as np
import pytest

from slamcli.estimation import camera_pose, minimal_solvers, pose_kernels
from slamcli.estimation.bundle_problem import Observations
from slamcli.estimation.camera_pose import Ransac, SeenPoints
from slamcli.estimation.measurements import Measurements
from slamcli.estimation.robust_loss import HUBER, LEAST_SQUARES, Huber
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

CAMERA = Camera(width=640, height=480, fx=520.0, fy=515.0, cx=319.5, cy=240.5)


def sigma_of(z: np.ndarray) -> np.ndarray:
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


def view(rng: np.random.Generator, n: int, *, noise: float = 1.0, outliers: float = 0.0, without_depth: float = 0.2):
    """A camera among n landmarks: true T_cw, landmarks, noisy pixels and depths with their sigmas, and which are not outliers."""
    xy = rng.uniform([0.0, 0.0], [640.0, 480.0], (n, 2))
    z = rng.uniform(0.5, 6.0, n)
    T_cw = se3.exp(rng.normal(size=6))
    x_w = se3.transform(se3.inverse(T_cw), CAMERA.backproject(xy, z))
    sigma_px, sigma_z = rng.choice([1.0, 1.44], n), sigma_of(z)
    xy = xy + noise * sigma_px[:, None] * rng.normal(size=(n, 2))
    depth = z + noise * sigma_z * rng.normal(size=n)
    depth[rng.random(n) < without_depth] = np.nan
    is_good = rng.random(n) >= outliers
    xy[~is_good] = rng.uniform([0.0, 0.0], [640.0, 480.0], ((~is_good).sum(), 2))
    return T_cw, x_w, xy, depth, sigma_px, sigma_z, is_good


def distance(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    return se3.log(T @ se3.inverse(T_true))


# --- minimal solvers


def test_p3p_finds_the_true_pose_and_only_poses_that_see_the_points():
    rng = np.random.default_rng(0)
    ray = np.concatenate([rng.uniform(-0.6, 0.6, (2000, 3, 2)), np.ones((2000, 3, 1))], axis=2)
    T_cw = se3.exp(rng.normal(size=(2000, 6)))
    x_c = ray * rng.uniform(0.4, 8.0, (2000, 3, 1))
    x_w = np.einsum("mij,mkj->mki", se3.inverse(T_cw)[:, :3, :3], x_c) + se3.inverse(T_cw)[:, None, :3, 3]
    found = minimal_solvers.p3p(x_w, ray)
    error = np.abs(found - T_cw[:, None, :3]).max(axis=(2, 3))
    assert np.mean(np.nanmin(error, axis=1) < 1e-6) > 0.999
    exists = np.isfinite(found[..., 0, 0])
    seen = np.einsum("msij,mkj->mski", found[..., :3], x_w) + found[:, :, None, :, 3]
    off = np.linalg.norm(np.cross(seen, ray[:, None]), axis=3).max(axis=2) / np.linalg.norm(seen, axis=3).min(axis=2)
    assert np.nanquantile(off, 0.999) < 1e-7
    R = found[exists][:, :, :3]
    assert np.quantile(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)), 0.999) < 1e-6
    assert (np.linalg.det(R) > 0.99).mean() > 0.999


def test_p3p_agrees_with_grunerts_quartic():
    rng = np.random.default_rng(1)
    n_checked = 0
    for _ in range(200):
        ray = np.append(rng.uniform(-0.6, 0.6, (3, 2)), np.ones((3, 1)), axis=1)
        x = ray * rng.uniform(0.5, 6.0, (3, 1))
        slow = sorted(naive.p3p_distances(x, ray), key=lambda d: tuple(d))
        T = minimal_solvers.p3p(x[None], ray[None])[0]
        fast = sorted((np.linalg.norm(x @ t[:, :3].T + t[:, 3], axis=1) for t in T if np.isfinite(t).all()), key=lambda d: tuple(d))
        if len(slow) == len(fast):  # at a double root rounding decides whether a pair of solutions exists
            n_checked += 1
            np.testing.assert_allclose(fast, slow, rtol=1e-4)
    assert n_checked > 190


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.outer([1.0, 2.0, 3.0], [1.0, 0.5, 2.0]), np.full((3, 3), np.nan)])
def test_minimal_solvers_answer_degenerate_samples_with_nan(points):
    ray = np.array([[[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]])
    assert np.isnan(minimal_solvers.p3p(points[None], ray)).all()
    assert np.isnan(minimal_solvers.rigid3(points[None], points[None] + 1.0)).all()


def test_rigid3_is_the_least_squares_motion():
    rng = np.random.default_rng(2)
    x_a = rng.normal(size=(300, 3, 3))
    T = se3.exp(rng.normal(size=(300, 6)) * 2.0)
    x_b = np.einsum("mij,mkj->mki", T[:, :3, :3], x_a) + T[:, None, :3, 3] + 0.05 * rng.normal(size=(300, 3, 3))
    found = minimal_solvers.rigid3(x_a, x_b)
    for m in range(300):
        np.testing.assert_allclose(found[m], se3.umeyama(x_a[m], x_b[m])[0][:3], atol=1e-7)


# --- RANSAC


def test_samples_are_distinct_and_even():
    sample = camera_pose.draw_samples(np.random.default_rng(3), 7, 20000, 4)
    assert (np.diff(np.sort(sample, axis=1), axis=1) > 0).all() and sample.min() == 0 and sample.max() == 6
    counts = np.stack([np.bincount(sample[:, k], minlength=7) for k in range(4)])
    assert np.abs(counts / 20000 - 1 / 7).max() < 0.012
    assert (np.sort(camera_pose.draw_samples(np.random.default_rng(3), 4, 9, 4), axis=1) == np.arange(4)).all()


@pytest.mark.parametrize(("outliers", "rounds"), [(0.0, (1, 5)), (0.3, (10, 60)), (0.5, (40, 100))])
def test_ransac_finds_the_pose_among_outliers(outliers, rounds):
    rng = np.random.default_rng(4)
    T_cw, x_w, xy, *_, is_good = view(rng, 300, outliers=outliers, noise=0.5)
    found = camera_pose.ransac_p3p(x_w, xy, CAMERA, rng=np.random.default_rng(0))
    assert 1e-5 < np.linalg.norm(distance(found.T_cw, T_cw)) < 0.05
    assert found.n_inliers == found.is_inlier.sum()
    assert (found.is_inlier & is_good).sum() > 0.8 * is_good.sum() and (found.is_inlier & ~is_good).mean() < 0.02
    assert 0.2 < found.rms < 3.0
    assert rounds[0] <= found.iterations <= rounds[1]  # it ends when another draw would hardly do better


def test_ransac_ranks_as_its_slow_twin():
    rng = np.random.default_rng(5)
    T_cw, x_w, xy, *_ = view(rng, 60, outliers=0.4)
    T = np.ascontiguousarray(se3.exp(0.02 * rng.normal(size=(40, 6))) @ T_cw)[:, :3].copy()
    T[3] = np.nan
    ray, is_inlier = (xy - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.zeros(60, dtype=bool)
    tested, rule = pose_kernels.Hypotheses(T, x_w, ray), Ransac(threshold_px=4.0, confidence=1.0 - 1e-15).agreement(CAMERA, 4)
    best, done = pose_kernels.rank(tested, tested, False, rule, is_inlier)
    assert best == naive.ranked(T, x_w, xy, CAMERA, 4.0) and done <= 40
    error = np.linalg.norm(CAMERA.project(se3.transform(np.vstack([T[best], [0, 0, 0, 1]]), x_w)) - xy, axis=1)
    np.testing.assert_array_equal(is_inlier, error < 4.0)


def test_ransac_stops_early_only_when_it_may():
    rng = np.random.default_rng(6)
    _, x_w, xy, *_ = view(rng, 200, noise=0.1)
    clean = camera_pose.ransac_p3p(x_w, xy, CAMERA, rng=np.random.default_rng(0))
    assert clean.iterations < 10
    xy[:120] = rng.uniform([0, 0], [640, 480], (120, 2))
    assert camera_pose.ransac_p3p(x_w, xy, CAMERA, rng=np.random.default_rng(0)).iterations == 100


def test_ransac_is_deterministic_in_its_seed():
    _, x_w, xy, *_ = view(np.random.default_rng(7), 200, outliers=0.4)
    a, b = (camera_pose.ransac_p3p(x_w, xy, CAMERA, rng=np.random.default_rng(1)) for _ in range(2))
    assert a.T_cw.tobytes() == b.T_cw.tobytes() and (a.is_inlier == b.is_inlier).all()


@pytest.mark.parametrize("n", [0, 1, 3])
def test_ransac_needs_enough_pairs(n):
    rng = np.random.default_rng(8)
    assert camera_pose.ransac_p3p(np.ones((n, 3)), np.ones((n, 2)), CAMERA, rng=rng) is None
    n = min(n, 2)
    seen = SeenPoints(np.ones((n, 3)), np.ones((n, 2)))
    assert camera_pose.ransac_rigid(seen, seen, CAMERA, rng=rng) is None


def test_ransac_survives_nan_and_points_all_in_one_place():
    rng = np.random.default_rng(9)
    T_cw, x_w, xy, *_ = view(rng, 100)
    x_w[::3], xy[1::7] = np.nan, np.nan
    found = camera_pose.ransac_p3p(x_w, xy, CAMERA, rng=rng)
    assert not found.is_inlier[::3].any() and not found.is_inlier[1::7].any()
    assert np.linalg.norm(distance(found.T_cw, T_cw)) < 0.1
    assert camera_pose.ransac_p3p(np.ones((50, 3)), np.ones((50, 2)), CAMERA, rng=rng) is None
    assert camera_pose.ransac_p3p(np.full((50, 3), np.nan), np.ones((50, 2)), CAMERA, rng=rng) is None


def test_rigid_ransac_finds_the_motion_and_checks_both_images():
    rng = np.random.default_rng(10)
    T_ba = se3.exp(np.array([0.3, -0.1, 0.2, 0.1, -0.2, 0.3]))
    x_a = CAMERA.backproject(rng.uniform([100, 100], [540, 380], (300, 2)), rng.uniform(1.5, 4.0, 300))
    x_b = se3.transform(T_ba, x_a)
    xy_a, xy_b = CAMERA.project(x_a) + 0.5 * rng.normal(size=(300, 2)), CAMERA.project(x_b) + 0.5 * rng.normal(size=(300, 2))
    x_a, x_b = x_a * (1 + 0.005 * rng.normal(size=(300, 1))), x_b * (1 + 0.005 * rng.normal(size=(300, 1)))
    xy_a[:60] += 30.0  # wrong in a alone
    xy_b[60:120] += 30.0  # wrong in b alone
    found = camera_pose.ransac_rigid(SeenPoints(x_a, xy_a), SeenPoints(x_b, xy_b), CAMERA, rng=rng, ransac=Ransac(200, 6.0))
    assert not found.is_inlier[:120].any() and found.is_inlier[120:].mean() > 0.7
    assert 1e-6 < np.linalg.norm(distance(found.T_ba, T_ba)) < 0.1
    assert 1 < found.iterations < 200, "most samples of the 180 pairs that agree are free of outliers"


# --- refinement


def test_normal_equations_equal_numerical_derivatives():
    rng = np.random.default_rng(11)
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(rng, 40, outliers=0.2)
    T = se3.exp(0.01 * rng.normal(size=6)) @ T_cw
    found = pose_kernels.System(np.zeros((6, 6)), np.zeros(6), np.empty(40))
    intrinsics = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])
    seen = pose_kernels.Seen(x_w, xy, depth, 1 / sigma_px, 1 / sigma_z)
    cost = pose_kernels.normal_equations(T, seen, np.ones(40, dtype=bool), intrinsics, HUBER, found)
    H, b, chi2 = found
    one = (T[None], x_w, Observations(np.zeros(40, dtype=int), np.arange(40), xy, depth, sigma_px, sigma_z), CAMERA, HUBER)
    H_slow, b_slow = naive.bundle_normal_equations(*one)
    np.testing.assert_allclose(cost, naive.bundle_cost(*one), rtol=1e-12)
    np.testing.assert_allclose(np.triu(H), np.triu(H_slow[:6, :6]), rtol=1e-5, atol=1e-5 * np.abs(H).max())
    np.testing.assert_allclose(b, b_slow[:6], rtol=1e-5, atol=1e-5 * np.abs(b).max())
    np.testing.assert_allclose(chi2[0], np.sum(naive.residual(T, x_w[0], xy[0], depth[0], sigma_px[0], sigma_z[0], CAMERA) ** 2))


def test_without_noise_the_pose_is_exact():
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(12), 50, noise=0.0)
    found = camera_pose.refine_pose(se3.exp(np.full(6, 0.03)) @ T_cw, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA)
    assert np.linalg.norm(distance(found.T_cw, T_cw)) < 1e-7 and found.n_inliers == 50 and found.rms < 1e-4


def test_the_error_is_what_the_information_says():
    chi2 = []
    for seed in range(200):
        T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(seed), 120)
        found = camera_pose.refine_pose(
            se3.exp(np.full(6, 0.01)) @ T_cw, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA, loss=Huber(30.0, 30.0)
        )
        xi = distance(found.T_cw, T_cw)
        chi2.append(xi @ found.information @ xi)
    assert 5.2 < np.mean(chi2) < 6.8  # chi2 of six degrees of freedom: 6 +- 0.25
    assert 0.88 < np.mean(np.array(chi2) < 12.59) < 0.99


def test_outliers_are_told_from_inliers():
    rng = np.random.default_rng(13)
    T_cw, x_w, xy, depth, sigma_px, sigma_z, is_good = view(rng, 1000, outliers=0.3)
    start = se3.exp(np.array([0.02, -0.01, 0.02, 0.01, 0.01, -0.01])) @ T_cw
    found = camera_pose.refine_pose(start, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA)
    xi = distance(found.T_cw, T_cw)
    assert 0.9 < (found.is_inlier & is_good).sum() / is_good.sum() < 0.99
    assert (found.is_inlier & ~is_good).sum() < 0.02 * 1000
    assert 0.5 < xi @ found.information @ xi < 40.0
    assert 1.4 < found.rms < 1.8  # 1.75 px, less what the tails hold


def test_depth_makes_the_pose_surer():
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(14), 200, noise=0.0, without_depth=0.0)
    without = np.full(200, np.nan)
    both = [camera_pose.refine_pose(T_cw, x_w, Measurements(xy, d, sigma_px, sigma_z), CAMERA).information for d in (depth, without)]
    assert np.linalg.eigvalsh(both[0] - both[1]).min() > -1e-6 * np.abs(both[0]).max()
    assert both[0][2, 2] > 1.5 * both[1][2, 2]


def test_without_the_kernel_it_is_least_squares():
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(20), 30)
    found = camera_pose.refine_pose(T_cw, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA, loss=LEAST_SQUARES)
    one = (x_w, Observations(np.zeros(30, dtype=int), np.arange(30), xy, depth, sigma_px, sigma_z), CAMERA)
    best = naive.bundle_cost(found.T_cw[None], *one)
    np.testing.assert_allclose(found.cost, best, rtol=1e-9)
    for step in np.concatenate([np.eye(6), -np.eye(6)]) * 1e-5:
        assert naive.bundle_cost((se3.exp(step) @ found.T_cw)[None], *one) > best


def test_an_observation_wrongly_thrown_out_comes_back():
    """From a start 25 px off nearly everything is an outlier at first."""
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(15), 300)
    found = camera_pose.refine_pose(
        se3.exp(np.array([0, 0, 0, 0.05, 0, 0])) @ T_cw, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA
    )
    assert 0.9 < found.n_inliers / 300 < 0.99


def test_hostile_observations_are_outliers_and_change_nothing():
    rng = np.random.default_rng(16)
    T_cw, *columns, _ = view(rng, 100)
    x_w, xy, depth, sigma_px, sigma_z = columns
    start = se3.exp(np.full(6, 0.005)) @ T_cw
    clean = camera_pose.refine_pose(start, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA)
    behind = se3.transform(se3.inverse(T_cw), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))
    x_w = np.concatenate([x_w, behind, [[np.nan, 0, 1], [np.inf, 0, 1]], x_w[:2], x_w[2:3]])
    xy = np.concatenate([xy, xy[:4], [[np.nan, 1.0], [1.0, -np.inf]], xy[2:3]])
    depth = np.concatenate([depth, np.ones(7)])
    sigma_px = np.concatenate([sigma_px, np.ones(6), [0.0]])
    sigma_z = np.concatenate([sigma_z, np.ones(7)])
    found = camera_pose.refine_pose(start, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA)
    assert not found.is_inlier[100:].any()
    np.testing.assert_array_equal(found.is_inlier[:100], clean.is_inlier)
    np.testing.assert_allclose(found.T_cw, clean.T_cw, atol=1e-5)


def test_a_depth_without_sigma_is_no_depth():
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(17), 60)
    a = camera_pose.refine_pose(T_cw, x_w, Measurements(xy, depth, sigma_px, np.full(60, np.nan)), CAMERA)
    b = camera_pose.refine_pose(T_cw, x_w, Measurements(xy, np.full(60, np.nan), sigma_px, sigma_z), CAMERA)
    assert a.T_cw.tobytes() == b.T_cw.tobytes()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_landmarks_neither_crash_nor_claim_to_know(n):
    T_cw, x_w, xy, depth, sigma_px, sigma_z, _ = view(np.random.default_rng(18), n)
    found = camera_pose.refine_pose(T_cw, x_w, Measurements(xy, depth, sigma_px, sigma_z), CAMERA)
    assert np.isfinite(found.T_cw).all() and found.n_inliers <= n
    assert np.linalg.matrix_rank(found.information, tol=1e-6 * max(1.0, np.abs(found.information).max())) <= 3 * n


def test_the_start_is_not_changed_and_float32_columns_are_taken():
    T_cw, *columns, _ = view(np.random.default_rng(19), 50)
    before = T_cw.copy()
    x_w, *measured = (c.astype(np.float32) for c in columns)
    found = camera_pose.refine_pose(T_cw, x_w, Measurements(*measured), CAMERA)
    assert (T_cw == before).all() and found.n_inliers > 40
