"""Edges in bundle adjustment: derivatives, laws, recovery, and g2o as the oracle."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import Scene, covariance, drive, pose_error

from slamcli.estimation import bundle_adjustment
from slamcli.estimation.relative_pose_factors import NO_EDGES, Edges, EdgeTerms, residuals
from slamcli.estimation.robust_loss import CHI2_95_6DOF, HUBER, LEAST_SQUARES
from slamcli.geometry import se3

SIGMA = np.array([0.004, 0.004, 0.004, 0.002, 0.002, 0.002])


def chain(T_true: np.ndarray, rng: np.random.Generator, *, noise: float = 1.0, reach: int = 2) -> Edges:
    """Measure the motion between key frames up to `reach` apart, with a full information matrix."""
    kf = np.array([(i, j) for i in range(len(T_true)) for j in range(max(0, i - reach), i)])
    mix = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    root = mix * SIGMA  # covariance = root root^T
    e = noise * rng.normal(size=(len(kf), 6)) @ root.T
    T_ij = se3.exp(e) @ T_true[kf[:, 0]] @ se3.inverse(T_true[kf[:, 1]])
    return Edges(kf, T_ij, np.broadcast_to(np.linalg.inv(root @ root.T), (len(kf), 6, 6)).copy())


def blank(scene: Scene) -> Scene:
    """Leave all landmarks out."""
    return replace(scene.keep(np.arange(0)), x_w=np.empty((0, 3)))


def numerical_gradient(terms: EdgeTerms, T_cw: np.ndarray, robust: bool, step: float = 1e-6) -> np.ndarray:
    gradient = np.zeros((len(T_cw), 6))
    for k in range(len(T_cw)):
        for a in range(6):
            cost = []
            for sign in (1.0, -1.0):
                T = T_cw.copy()
                T[k] = se3.exp(sign * step * np.eye(6)[a]) @ T[k]
                cost.append(terms.cost(T, robust))
            gradient[k, a] = (cost[0] - cost[1]) / (2.0 * step)
    return gradient


@pytest.mark.parametrize("robust", [False, True])
def test_the_gradient_equals_numerical_derivatives(robust):
    rng = np.random.default_rng(0)
    scene = drive(5, 20, seed=1, start=2.0)
    edges = chain(scene.T_true, rng)
    block_of = np.arange(25, dtype=np.int32).reshape(5, 5)
    terms = EdgeTerms(edges, np.arange(5), block_of)
    U, b = np.zeros((5, 6, 6)), np.zeros((5, 6))
    terms.linearize(scene.T_cw, robust, U, b)
    expected = -0.5 * numerical_gradient(terms, scene.T_cw, robust)
    np.testing.assert_allclose(b, expected, rtol=2e-4, atol=2e-4 * np.abs(expected).max())
    np.testing.assert_allclose(U, np.swapaxes(U, 1, 2), rtol=1e-9, atol=1e-6 * np.abs(U).max())


def test_blocks_equal_the_derivatives_of_the_residuals():
    rng = np.random.default_rng(1)
    scene = drive(4, 20, start=1.0)
    edges = chain(scene.T_true, rng)
    n, step = 4, 1e-6
    J = np.zeros((len(edges), 6, 6 * n))
    for c in range(6 * n):
        e = []
        for sign in (1.0, -1.0):
            T = scene.T_cw.copy()
            T[c // 6] = se3.exp(sign * step * np.eye(6)[c % 6]) @ T[c // 6]
            e.append(residuals(edges, T)[0])
        J[:, :, c] = (e[0] - e[1]) / (2.0 * step)
    whole = np.einsum("eac,eab,ebd->cd", J, edges.information, J)
    row, column = np.triu_indices(n, 1)
    row, column = np.append(np.arange(n), row), np.append(np.arange(n), column)
    block_of = np.full((n, n), -1, dtype=np.int32)
    block_of[row, column] = np.arange(len(row))
    place = np.array([2, 0, 3, 1])  # an order of its own
    terms = EdgeTerms(edges, place, block_of)
    U, blocks = np.zeros((n, 6, 6)), np.zeros((len(row), 6, 6))
    terms.linearize(scene.T_cw, False, U, np.zeros((n, 6)))
    terms.add_to(blocks)
    kf_at = np.argsort(place)
    for s, (r, c) in enumerate(zip(row, column, strict=True)):
        a, b = kf_at[r], kf_at[c]
        block = U[r] if r == c else blocks[s]
        np.testing.assert_allclose(block, whole[6 * a : 6 * a + 6, 6 * b : 6 * b + 6], rtol=1e-4, atol=1e-4 * np.abs(whole).max())


def test_edges_alone_bring_the_truth_back_and_leave_the_gauge_free():
    scene = drive(8, 20, start=2.0)
    edges = chain(scene.T_true, np.random.default_rng(2), noise=0.0)
    tied = bundle_adjustment.adjust(blank(scene).problem(edges=edges), max_iterations=30, tolerance=1e-14)
    assert np.abs(pose_error(tied.T_cw, scene.T_true)).max() < 1e-6
    G = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.4, 0.9]))
    moved = bundle_adjustment.adjust(blank(replace(scene, T_cw=scene.T_cw @ G)).problem(edges=edges), max_iterations=30, tolerance=1e-14)
    np.testing.assert_allclose(moved.T_cw @ se3.inverse(G), tied.T_cw, atol=1e-6)


def test_chi2_and_covariance_are_what_statistics_say():
    chi2, cost = [], []
    for seed in range(20):
        scene = drive(6, 20, seed=seed, start=0.2)
        edges = chain(scene.T_true, np.random.default_rng(seed))
        bare = scene.keep(np.arange(0))
        result = bundle_adjustment.adjust(bare.problem(edges=edges, loss=LEAST_SQUARES), max_iterations=20)
        e = pose_error(result.T_cw, scene.T_true)[1:].ravel()
        chi2.append(e @ np.linalg.solve(covariance(bare, result, range(1, 6), edges), e))
        cost.append(result.cost[-1] / (6 * len(edges) - 30))
    assert 25.0 < np.mean(chi2) < 35.0  # 30 degrees of freedom: 30 +- 1.7
    assert 0.85 < np.mean(cost) < 1.15


def test_edges_and_landmarks_add_up():
    """Together they are surer than either alone, and a key frame that no landmark holds is held by its edges."""
    scene = drive(6, 120, seed=3)
    without = scene.keep(np.flatnonzero(scene.obs_kf != 4))
    edges = chain(scene.T_true, np.random.default_rng(3))
    both, landmarks = (bundle_adjustment.adjust(without.problem(edges=e), max_iterations=20) for e in (edges, NO_EDGES))
    bare = scene.keep(np.arange(0))
    only = bundle_adjustment.adjust(bare.problem(edges=edges), max_iterations=20)
    joint, a, b = (
        np.trace(covariance(s, r, [2], e)) for s, r, e in ((without, both, edges), (without, landmarks, NO_EDGES), (bare, only, edges))
    )
    assert 0.2 * min(a, b) < joint < min(a, b)
    assert np.abs(pose_error(both.T_cw, scene.T_true)[4]).max() < 0.02
    assert (landmarks.T_cw[4] == scene.T_cw[4]).all()


def test_a_false_edge_bends_less_than_its_error():
    scene = drive(8, 250, seed=4)
    edges = chain(scene.T_true, np.random.default_rng(4))
    T_ij = edges.T_ij.copy()
    T_ij[5] = se3.exp(np.array([0.5, 0.0, 0.2, 0.1, 0.0, 0.0])) @ T_ij[5]
    wrong = replace(edges, T_ij=T_ij)
    right, robust, trusting = (
        bundle_adjustment.adjust(scene.problem(edges=e, loss=r), max_iterations=30)
        for e, r in ((edges, HUBER), (wrong, HUBER), (wrong, LEAST_SQUARES))
    )
    error = [np.linalg.norm(pose_error(r.T_cw, scene.T_true)[:, :3], axis=1).max() for r in (right, robust, trusting)]
    assert error[1] < error[0] + 0.01 and error[2] > 3.0 * error[1]
    assert residuals(wrong, robust.T_cw)[0][5] @ wrong.information[5] @ residuals(wrong, robust.T_cw)[0][5] > 10.0 * CHI2_95_6DOF


@pytest.mark.parametrize("n_kf", [12, 60])
def test_without_edges_nothing_changes_and_many_key_frames_take_the_same_road(n_kf):
    scene = drive(n_kf, 6 * n_kf, seed=5, share=0.5, step=0.4, start=0.3)
    far = Edges(np.array([[n_kf - 1, 0]]), (scene.T_true[n_kf - 1] @ se3.inverse(scene.T_true[0]))[None], np.diag(SIGMA**-2.0)[None])
    for edges in (far, chain(scene.T_true, np.random.default_rng(5))):
        result = bundle_adjustment.adjust(scene.problem(edges=edges), max_iterations=4, tolerance=0.0)
        problem = scene.problem(edges=edges)
        problem.system.form = "dense"
        cost = bundle_adjustment.minimize(problem, max_iterations=4, tolerance=0.0).cost
        np.testing.assert_allclose(result.cost, cost, rtol=1e-9)
        assert result.cost[-1] < result.cost[0]


def test_g2o_reaches_the_same_cost():
    from slamcli.estimation import pose_graph

    scene = drive(10, 20, seed=6, start=1.0)
    edges = chain(scene.T_true, np.random.default_rng(6), reach=3)
    ours = bundle_adjustment.adjust(blank(scene).problem(edges=edges, loss=LEAST_SQUARES), max_iterations=50, tolerance=1e-13)
    peer = pose_graph.optimize(se3.inverse(scene.T_cw), edges, is_fixed=scene.first)
    np.testing.assert_allclose(ours.cost[-1], peer.cost, rtol=1e-3)  # g2o minimizes a residual that differs in the second order
    np.testing.assert_allclose(se3.inverse(peer.T_wk), ours.T_cw, atol=2e-4)
