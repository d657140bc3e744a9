"""Bundle adjustment: derivatives, the reduced system, laws, recovery, and g2o as the oracle."""

from dataclasses import replace
from pathlib import Path

import naive
import numpy as np
import pytest
from bundle_scene import Scene, covariance, drive, pose_error

from slamcli.estimation import bundle_adjustment, reduced_camera_system
from slamcli.estimation.bundle_problem import Problem, Variables
from slamcli.estimation.robust_loss import HUBER, LEAST_SQUARES
from slamcli.geometry import se3


def full_system(scene: Scene, T: np.ndarray, x: np.ndarray, limits=HUBER) -> tuple[np.ndarray, np.ndarray]:
    return naive.bundle_normal_equations(T, x, *scene.given[2:], limits)


# --- kernels against their slow twins


def linearized(scene: Scene) -> Problem:
    problem = scene.problem(is_fixed=np.zeros(len(scene.T_cw), dtype=bool))
    problem.linearize(problem.start)
    return problem


def test_blocks_equal_numerical_derivatives():
    scene = drive(3, 25, share=0.7)
    H, b = full_system(scene, scene.T_cw, scene.x_w)
    problem = linearized(scene)
    n, scale = 18, {"rtol": 1e-5, "atol": 1e-6 * np.abs(H).max()}
    for k in range(3):
        np.testing.assert_allclose(np.triu(problem.normal.U[k]), np.triu(H[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]), **scale)
    for lm in range(25):
        rows = slice(n + 3 * lm, n + 3 * lm + 3)
        np.testing.assert_allclose(problem.normal.V[lm], H[rows, rows][np.triu_indices(3)], **scale)
    np.testing.assert_allclose(
        np.concatenate([problem.normal.b_c.ravel(), problem.normal.b_l.ravel()]), b, rtol=1e-5, atol=1e-6 * np.abs(b).max()
    )
    for o in range(len(scene.obs_kf)):
        k, lm = scene.obs_kf[o], scene.obs_lm[o]
        np.testing.assert_allclose(problem.normal.W[o], H[n + 3 * lm : n + 3 * lm + 3, 6 * k : 6 * k + 6], **scale)


def test_cost_equals_its_slow_twin():
    scene = drive(4, 60, share=0.6)
    for loss in (HUBER, LEAST_SQUARES):
        fast = scene.problem(loss=loss).cost(Variables(scene.T_cw, scene.x_w))
        np.testing.assert_allclose(fast, naive.bundle_cost(*scene.given, loss), rtol=1e-12)


@pytest.mark.parametrize("is_fixed", [[True, False, False, False], [False, True, True, False], [True] * 4])
def test_a_step_solves_the_damped_normal_equations(is_fixed):
    scene = drive(4, 40, share=0.7)
    problem = scene.problem(is_fixed=np.array(is_fixed))
    damping = 1e-3
    problem.linearize(problem.start)
    (T, x), expected = problem.step(problem.start, damping)
    H, b = full_system(scene, scene.T_cw, scene.x_w)
    is_free = np.concatenate([np.repeat(~np.array(is_fixed), 6), np.repeat(np.bincount(scene.obs_lm, minlength=40) > 0, 3)])
    H, b = H[np.ix_(is_free, is_free)], b[is_free]
    D = damping * np.diag(np.diag(H))
    dx = np.zeros(len(is_free))
    dx[is_free] = np.linalg.solve(H + D, b)
    np.testing.assert_allclose(T, se3.exp(dx[:24].reshape(4, 6)) @ scene.T_cw, atol=1e-6)
    np.testing.assert_allclose(x, scene.x_w + dx[24:].reshape(-1, 3), atol=1e-6)
    np.testing.assert_allclose(expected, dx[is_free] @ (b + D @ dx[is_free]), rtol=1e-5)


@pytest.mark.parametrize("n", [1, 2, 7, 60])
@pytest.mark.parametrize("form", ["dense", "band", "iterative"])
def test_every_form_of_the_reduced_system_solves_it(n, form):
    rng = np.random.default_rng(n)
    row, column = np.triu_indices(n, 1)
    near = column - row <= 3
    row, column = np.append(np.arange(n), row[near]), np.append(np.arange(n), column[near])
    system = reduced_camera_system.ReducedSystem(row, column, n)
    whole = np.zeros((6 * n, 6 * n))
    for s, (r, c) in enumerate(zip(row, column, strict=True)):
        block = rng.normal(size=(6, 6))
        block = block @ block.T + 200.0 * np.eye(6) if r == c else block
        whole[6 * r : 6 * r + 6, 6 * c : 6 * c + 6] = block
        whole[6 * c : 6 * c + 6, 6 * r : 6 * r + 6] = block.T
        system.blocks[s] = np.triu(block) + np.tril(np.full((6, 6), 1e6), -1) if r == c else block  # below the diagonal nothing counts
    rhs = rng.normal(size=(6 * n, 3))
    system.form = form
    np.testing.assert_allclose(system.factorize().solve(rhs), np.linalg.solve(whole, rhs), rtol=1e-6, atol=1e-10)


def test_an_indefinite_system_is_reported():
    system = reduced_camera_system.ReducedSystem(np.array([0]), np.array([0]), 1)
    system.blocks[0] = -np.eye(6)
    assert system.factorize() is None


def test_key_frames_are_ordered_into_a_band():
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(80)
    obs_kf = np.concatenate([shuffled[k : k + 3] for k in range(78)])
    place, system = reduced_camera_system.order_and_blocks(
        np.arange(80), obs_kf, np.repeat(np.arange(78), 3), 80, np.empty((0, 2), dtype=int)
    )
    assert system.form == "band" and system.bandwidth <= 6 * 4 + 5
    assert (np.abs(np.diff(place[shuffled])) <= 4).all()


# --- laws


def test_cost_does_not_feel_where_the_world_stands():
    scene = drive(5, 80)
    G = se3.exp(np.array([3.0, -2.0, 1.0, 0.4, 1.0, -0.7]))
    moved = replace(scene, T_cw=scene.T_cw @ se3.inverse(G), x_w=se3.transform(G, scene.x_w))
    a, b = (bundle_adjustment.adjust(s.problem(), max_iterations=30, tolerance=1e-12) for s in (scene, moved))
    np.testing.assert_allclose(a.cost[0], b.cost[0], rtol=1e-9)
    np.testing.assert_allclose(a.cost[-1], b.cost[-1], rtol=1e-9)
    np.testing.assert_allclose(b.T_cw @ G, a.T_cw, atol=1e-6)


def test_the_reduced_system_has_six_free_directions_when_nothing_is_fixed():
    scene = drive(5, 80, noise=0.0, start=0.0)
    problem = linearized(scene)
    problem.eliminate(0.0, np.zeros(5))
    S = problem.system._upper(30)[:900].reshape(30, 30)
    S = np.triu(S) + np.triu(S, 1).T
    values = np.linalg.eigvalsh(S)
    assert (np.abs(values[:6]) < 1e-7 * values[-1]).all() and values[6] > 1e-5 * values[-1]
    gauge = se3.adjoint(scene.T_cw).reshape(30, 6)  # a twist of the world moves every T_cw by its adjoint
    assert np.abs(S @ gauge).max() < 1e-6 * np.abs(S).max()


def test_without_a_fixed_key_frame_the_same_cost_is_reached():
    scene = drive(6, 100)
    nothing = np.zeros(6, dtype=bool)
    tied, free = (bundle_adjustment.adjust(scene.problem(is_fixed=f), max_iterations=40, tolerance=1e-12) for f in (scene.first, nothing))
    np.testing.assert_allclose(free.cost[-1], tied.cost[-1], rtol=1e-7)


def test_fixed_key_frames_and_the_input_stay_bit_for_bit():
    scene = drive(6, 100)
    names = ("T_cw", "x_w", "obs_kf", "obs_lm", "xy", "depth", "sigma_px", "sigma_z")
    before = {name: np.array(getattr(scene, name)) for name in names}
    is_fixed = np.array([True, False, True, False, False, True])
    result = bundle_adjustment.adjust(scene.problem(is_fixed=is_fixed))
    assert result.T_cw[is_fixed].tobytes() == scene.T_cw[is_fixed].tobytes()
    assert (result.T_cw[~is_fixed] != scene.T_cw[~is_fixed]).any(axis=(1, 2)).all()
    for name, value in before.items():
        np.testing.assert_array_equal(value, getattr(scene, name))


def test_the_cost_never_rises_and_same_input_gives_same_bytes():
    scene = drive(10, 300, start=3.0)
    a, b = (bundle_adjustment.adjust(scene.problem(), max_iterations=20) for _ in range(2))
    assert (np.diff(a.cost) < 0).all() and a.is_converged
    assert a.T_cw.tobytes() == b.T_cw.tobytes() and a.x_w.tobytes() == b.x_w.tobytes() and a.cost == b.cost


def test_rotations_stay_rotations():
    scene = drive(6, 100, start=4.0)
    T = bundle_adjustment.adjust(scene.problem(), max_iterations=50).T_cw
    np.testing.assert_allclose(T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-12)


# --- recovery


def test_without_noise_the_truth_comes_back():
    scene = drive(8, 200, noise=0.0)
    result = bundle_adjustment.adjust(scene.problem(), max_iterations=30, tolerance=1e-14)
    is_seen = np.bincount(scene.obs_lm, minlength=200) > 0
    assert result.cost[-1] < 1e-10 * result.cost[0]
    assert np.abs(pose_error(result.T_cw, scene.T_true)).max() < 1e-6
    assert np.abs(result.x_w - scene.x_true)[is_seen].max() < 1e-5
    assert result.is_inlier.all()


def test_with_noise_the_cost_and_the_errors_are_what_statistics_say():
    chi2_pose, reduced = [], []
    for seed in range(12):
        scene = drive(6, 150, seed=seed)
        result = bundle_adjustment.adjust(scene.problem(loss=LEAST_SQUARES), max_iterations=20, tolerance=1e-9)
        n_seen = (np.bincount(scene.obs_lm, minlength=150) > 0).sum()
        freedom = 2 * len(scene.xy) + np.isfinite(scene.depth).sum() - 6 * 5 - 3 * n_seen
        reduced.append(result.cost[-1] / freedom)
        e = pose_error(result.T_cw, scene.T_true)[1:].ravel()
        chi2_pose.append(e @ np.linalg.solve(covariance(scene, result, range(1, 6)), e))
    assert 0.97 < np.mean(reduced) < 1.03
    assert 25.0 < np.mean(chi2_pose) < 35.0  # 30 degrees of freedom: 30 +- 2.2


def test_the_inverse_of_the_reduced_system_is_the_covariance_of_the_key_frames():
    scene = drive(4, 60, noise=0.5, share=0.8)
    result = bundle_adjustment.adjust(scene.problem(), max_iterations=20, tolerance=1e-10)
    H, _ = full_system(scene, result.T_cw, result.x_w, LEAST_SQUARES)
    used = np.concatenate([np.zeros(6, dtype=bool), np.ones(18, dtype=bool), np.repeat(np.bincount(scene.obs_lm, minlength=60) > 0, 3)])
    whole = np.zeros_like(H)
    whole[np.ix_(used, used)] = np.linalg.inv(H[np.ix_(used, used)])
    rows = np.r_[6:12, 18:24]
    np.testing.assert_allclose(covariance(scene, result, [1, 3]), whole[np.ix_(rows, rows)], rtol=1e-4, atol=1e-12)


def test_outliers_are_found_and_hardly_harm():
    scene = drive(8, 300)
    rng = np.random.default_rng(1)
    is_bad = rng.random(len(scene.xy)) < 0.08
    xy = scene.xy.copy()
    xy[is_bad] += rng.uniform(15, 80, (is_bad.sum(), 2)) * rng.choice([-1, 1], (is_bad.sum(), 2))
    dirty = replace(scene, xy=xy)
    clean = bundle_adjustment.adjust(scene.problem(), max_iterations=20)
    result = bundle_adjustment.adjust(dirty.problem(), max_iterations=20)
    careless = bundle_adjustment.adjust(dirty.problem(loss=LEAST_SQUARES), max_iterations=20)
    error = [np.linalg.norm(pose_error(r.T_cw, scene.T_true)[:, :3], axis=1).mean() for r in (clean, result, careless)]
    assert (result.is_inlier & is_bad).sum() < 0.05 * is_bad.sum()
    assert (result.is_inlier & ~is_bad).sum() > 0.85 * (~is_bad).sum()
    assert error[1] < 2.5 * error[0] and error[1] < 0.5 * error[2]
    assert (result.chi2[is_bad] > 0).all()  # of dropped ones too


# --- many key frames


@pytest.mark.parametrize("n_kf", [60, 320])
def test_long_drives_take_the_same_road_as_short_ones(n_kf):
    """A band of 60 key frames, and one of 320 in which few share landmarks, against the dense system."""
    scene = drive(n_kf, 6 * n_kf, seed=6, share=0.5, step=0.4, start=0.3)
    result = bundle_adjustment.adjust(scene.problem(), max_iterations=4, tolerance=0.0)
    problem = scene.problem()
    assert problem.system.form == "band"
    problem.system.form = "dense"
    found = bundle_adjustment.minimize(problem, max_iterations=4, tolerance=0.0)
    np.testing.assert_allclose(result.T_cw, found.at.T_cw, rtol=1e-5, atol=1e-5)  # rounding, along a drive of up to 128 m
    np.testing.assert_allclose(result.cost, found.cost, rtol=1e-9)


# --- the oracle


def test_g2o_reaches_the_same_cost(tmp_path: Path):
    from g2o_bundle import G2oBundle

    scene = drive(6, 150, seed=7)
    rng = np.random.default_rng(0)
    scene.xy[rng.random(len(scene.xy)) < 0.05] += 20.0
    ours = bundle_adjustment.adjust(scene.problem(), max_iterations=60, tolerance=1e-13)
    peer = G2oBundle(*scene.given, is_fixed=scene.first, limits=HUBER, folder=tmp_path)
    np.testing.assert_allclose(peer.cost(), ours.cost[0], rtol=1e-9)
    peer.optimize(200)
    np.testing.assert_allclose(peer.cost(), ours.cost[-1], rtol=1e-6)
    np.testing.assert_allclose(peer.T_cw(), ours.T_cw, atol=2e-5)
