"""The pose graph: laws, recovery, false edges, g2o's own arithmetic, files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.errors import SlamError
from slamcli.estimation import pose_graph
from slamcli.estimation.pose_graph_solver import Graph
from slamcli.estimation.relative_pose_factors import NO_EDGES, Edges
from slamcli.estimation.repeated_edges import share_of_information
from slamcli.formats.g2o import read_g2o, write_g2o
from slamcli.geometry import se3
from slamcli.geometry.g2o_convention import from_g2o_information, to_g2o_information

SIGMA = np.array([0.01, 0.01, 0.01, 0.005, 0.005, 0.005])
N_KF = 80


def laps(n: int = N_KF, turns: float = 1.4) -> np.ndarray:
    """Key frames on a circle of 2 m radius, looking outwards."""
    angle = np.linspace(0.0, 2.0 * np.pi * turns, n)
    T = se3.exp(np.column_stack([np.zeros((n, 4)), angle, np.zeros(n)]))
    T[:, 0, 3], T[:, 2, 3] = 2.0 * np.sin(angle), 2.0 * np.cos(angle)
    return T


def between(T_w: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return se3.inverse(T_w[edges[:, 0]]) @ T_w[edges[:, 1]]


def ape(T: np.ndarray, T_true: np.ndarray) -> float:
    return float(np.sqrt(((T - T_true)[:, :3, 3] ** 2).sum(axis=1).mean()))


def revisits(rng: np.random.Generator, n: int) -> np.ndarray:
    lap = round(N_KF / 1.4)
    later = rng.choice(np.arange(lap, N_KF), n, replace=False)
    return np.column_stack([later, later - lap])


def chain(seed: int, closures: int, *, sigma: np.ndarray = SIGMA):
    """A drive measured step by step, and closures: truth, dead reckoning, edges, measurements, information."""
    rng = np.random.default_rng(seed)
    T_true = laps()
    steps = np.column_stack([np.arange(1, N_KF), np.arange(N_KF - 1)])
    edges = np.concatenate([steps, revisits(rng, closures)])
    measured = se3.exp(rng.normal(size=(len(edges), 6)) * sigma) @ between(T_true, edges)
    T = [T_true[0]]
    for k in range(N_KF - 1):
        T.append(T[-1] @ se3.inverse(measured[k]))
    return T_true, np.array(T), edges, measured, np.tile(np.diag(sigma**-2.0), (len(edges), 1, 1))


FIRST = np.arange(N_KF) == 0


# --- laws


def test_a_consistent_graph_stays_as_it_is():
    T, *_ = chain(0, 0)
    edges = np.array([(i, j) for i in range(N_KF) for j in range(max(0, i - 3), i)])
    information = np.tile(np.diag(SIGMA**-2.0), (len(edges), 1, 1))
    result = pose_graph.optimize(T, Edges(edges, between(T, edges), information), is_fixed=FIRST)
    np.testing.assert_allclose(result.T_wk, T, atol=1e-9)
    assert result.cost < 1e-9 and result.is_kept.all()


def test_where_the_world_stands_does_not_matter():
    _, T, edges, measured, information = chain(1, 5)
    G = se3.exp(np.array([1.0, 2.0, -1.0, 0.5, -1.0, 0.3]))
    a = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST)
    b = pose_graph.optimize(G @ T, Edges(edges, measured, information), is_fixed=FIRST)
    np.testing.assert_allclose(b.T_wk, G @ a.T_wk, atol=1e-7)


def test_fixed_key_frames_stay_and_one_must_be_fixed():
    _, T, edges, measured, information = chain(2, 4)
    is_fixed = np.isin(np.arange(N_KF), [0, 40, 79])
    result = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=is_fixed)
    np.testing.assert_allclose(result.T_wk[is_fixed], T[is_fixed], atol=1e-12)
    with pytest.raises(ValueError, match="fixed"):
        pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=np.zeros(N_KF, dtype=bool))


def test_same_input_same_bytes():
    rng = np.random.default_rng(3)
    _, T, edges, measured, information = chain(3, 6)
    measured[-1] = se3.exp(rng.normal(size=6)) @ measured[-1]
    robust = np.arange(len(edges)) >= N_KF - 1
    a, b = (pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST, is_robust=robust) for _ in range(2))
    assert a.T_wk.tobytes() == b.T_wk.tobytes()


def test_no_edges_and_no_robust_edges():
    T = laps(5)
    nothing = pose_graph.optimize(T, NO_EDGES, is_fixed=np.arange(5) == 0)
    assert (nothing.T_wk == T).all() and len(nothing.chi2) == 0 and nothing.cost == 0.0


def test_a_part_that_hangs_on_nothing_stays():
    _, T, edges, measured, information = chain(4, 3)
    cut = (edges.max(axis=1) < 60) | (edges.min(axis=1) >= 60)  # key frames from 60 on are cut off
    robust = (np.arange(len(edges)) >= N_KF - 1)[cut]
    result = pose_graph.optimize(T, Edges(edges[cut], measured[cut], information[cut]), is_fixed=FIRST, is_robust=robust)
    assert np.isfinite(result.T_wk).all()
    np.testing.assert_allclose(result.T_wk[60:], T[60:], atol=1e-6)


# --- recovery


def test_errors_and_cost_are_what_the_information_says():
    cost, chi2 = [], []
    for seed in range(25):
        T_true, T, edges, measured, information = chain(seed, 10)
        result = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST)
        cost.append(result.cost / (6 * 10))  # degrees of freedom: six per edge beyond the tree
        graph = Graph(result.T_wk, Edges(edges, measured, information), FIRST)
        pair = np.array([len(edges) - 1])
        e = graph.residual()[pair].ravel() - se3.log(between(T_true, edges[pair]) @ se3.inverse(measured[pair])).ravel()
        chi2.append(e @ np.linalg.solve(graph.posterior(np.ones(len(edges), dtype=bool)).covariance(pair), e))
    assert 0.85 < np.mean(cost) < 1.15
    assert 4.5 < np.mean(chi2) < 7.5  # six degrees of freedom: 6 +- 0.7


def test_closures_take_the_drift_out():
    T_true, T, edges, measured, information = chain(5, 8)
    result = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST)
    assert 0.001 < ape(result.T_wk, T_true) < 0.5 * ape(T, T_true)


@pytest.mark.parametrize("true", [0, 1, 2, 8])
@pytest.mark.parametrize("seed", range(4))
def test_a_planted_false_edge_changes_nothing(seed, true):
    rng = np.random.default_rng(100 + seed)
    T_true, T, edges, measured, information = chain(seed, true)
    i, j = sorted(rng.choice(N_KF, 2, replace=False))
    false = se3.exp(rng.normal(size=6) * [0.7, 0.3, 0.7, 0.3, 0.5, 0.3]) @ between(T_true, np.array([[j, i]]))
    clean = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST)
    edges, measured = np.vstack([edges, [[j, i]]]), np.concatenate([measured, false])
    information = np.concatenate([information, information[:1]])
    robust = np.arange(len(edges)) >= N_KF - 1
    found = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST, is_robust=robust)
    assert found.is_kept[:-1].all() and not found.is_kept[-1]
    assert found.chi2[-1] > pose_graph.CHI2_99_6DOF
    assert abs(ape(found.T_wk, T_true) / ape(clean.T_wk, T_true) - 1.0) < 0.01


def test_a_lone_false_edge_is_seen_though_its_own_residual_vanishes():
    """Least squares bends the chain until the false edge fits within its limit: its own chi2 cannot tell."""
    T_true, T, edges, measured, information = chain(6, 0)
    false = se3.exp(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])) @ between(T_true, np.array([[70, 5]]))
    edges, measured = np.vstack([edges, [[70, 5]]]), np.concatenate([measured, false])
    information = np.concatenate([information, information[:1]])
    bent = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST)
    robust = np.arange(len(edges)) == len(edges) - 1
    found = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST, is_robust=robust)
    assert bent.chi2[-1] < pose_graph.CHI2_99_6DOF < found.chi2[-1]
    assert not found.is_kept[-1]
    np.testing.assert_allclose(found.T_wk, T, atol=1e-6)


def test_a_group_of_false_edges_that_agree_with_each_other():
    rng = np.random.default_rng(7)
    T_true, T, edges, measured, information = chain(7, 8)
    clean = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST)
    false = np.array([[60, 20], [61, 21], [62, 21]])
    E = se3.exp(np.array([0.8, 0.0, -0.6, 0.0, 0.4, 0.0]))
    wrong = se3.exp(0.2 * rng.normal(size=(3, 6)) * SIGMA) @ E @ between(T_true, false)
    edges, measured = np.vstack([edges, false]), np.concatenate([measured, wrong])
    information = np.concatenate([information, information[:3]])
    robust = np.arange(len(edges)) >= N_KF - 1
    found = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST, is_robust=robust)
    assert found.is_kept[:-3].all() and not found.is_kept[-3:].any()
    np.testing.assert_allclose(ape(found.T_wk, T_true), ape(clean.T_wk, T_true), rtol=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_many_false_edges_by_metres_and_half_turns_do_not_take_the_true_ones_with_them(seed):
    """As between the equal doors of a corridor, where most of what looks alike is another door."""
    rng = np.random.default_rng(200 + seed)
    T_true, T, edges, measured, information = chain(6 + seed, 3)
    lap = round(N_KF / 1.4)
    ends = np.array([sorted(rng.choice(N_KF, 2, replace=False))[::-1] for _ in range(40)])
    ends = ends[(np.abs(ends[:, 0] - ends[:, 1]) > 8) & (np.abs(np.abs(ends[:, 0] - ends[:, 1]) - lap) > 4)][:12]
    twist = np.zeros((len(ends), 6))
    twist[:, 0] = 2.0 * rng.integers(1, 10, len(ends))
    twist[:, 4] = np.pi * (1.0 - 1e-3) * rng.integers(0, 2, len(ends))
    edges = np.concatenate([edges, ends])
    measured = np.concatenate([measured, se3.exp(twist) @ between(T_true, ends)])
    information = np.concatenate([information, np.tile(information[:1], (len(ends), 1, 1))])
    is_robust = np.arange(len(edges)) >= N_KF - 1
    result = pose_graph.optimize(T, Edges(edges, measured, information), is_fixed=FIRST, is_robust=is_robust)
    np.testing.assert_array_equal(result.is_kept[is_robust], np.arange(3 + len(ends)) < 3)
    alone = slice(0, N_KF + 2)
    without = pose_graph.optimize(T, Edges(edges[alone], measured[alone], information[alone]), is_fixed=FIRST, is_robust=is_robust[alone])
    np.testing.assert_allclose(result.T_wk, without.T_wk, atol=1e-4)


def test_edges_that_repeat_each_other_do_not_stiffen_the_chain():
    """Ten map edges per key frame hold the drift; closures must still be believed, and a false one not."""
    rng = np.random.default_rng(8)
    T_true = laps()
    drift = np.array([0.002, 0.001, 0.002, 0.0, 0.0015, 0.0])
    T = [T_true[0]]
    for k in range(N_KF - 1):
        T.append(T[-1] @ between(T_true, np.array([[k, k + 1]]))[0] @ se3.exp(drift + 0.3 * rng.normal(size=6) * SIGMA))
    T = np.array(T)
    chain_edges = np.array([(i, i - s) for i in range(N_KF) for s in range(1, 11) if i >= s])
    loops = revisits(rng, 6)
    edges = np.vstack([chain_edges, loops, [[50, 12]]])
    measured = np.concatenate([between(T, chain_edges), se3.exp(0.3 * rng.normal(size=(7, 6)) * SIGMA) @ between(T_true, edges[-7:])])
    measured[-1] = se3.exp(np.array([0.5, 0, 0.5, 0, 0.3, 0])) @ measured[-1]
    information = np.tile(np.diag(SIGMA**-2.0), (len(edges), 1, 1))
    robust = np.arange(len(edges)) >= len(chain_edges)
    taken = Edges(edges, measured, information)
    shared = replace(taken, information=information * share_of_information(taken, ~robust)[:, None, None])
    found, stiff = (pose_graph.optimize(T, e, is_fixed=FIRST, is_robust=robust) for e in (shared, taken))
    assert ape(T, T_true) > 0.12
    assert found.is_kept[:-1].all() and not found.is_kept[-1]
    assert 0.01 < ape(found.T_wk, T_true) < 0.6 * ape(T, T_true)
    assert not stiff.is_kept[-7:].any()  # what would happen otherwise


def edges_of(kf: np.ndarray) -> Edges:
    return Edges(kf, np.tile(np.eye(4), (len(kf), 1, 1)), np.tile(np.eye(6), (len(kf), 1, 1)))


def test_the_share_of_parallel_edges():
    single = np.array([(k + 1, k) for k in range(20)])
    trusted = np.ones(20, dtype=bool)
    np.testing.assert_allclose(share_of_information(edges_of(single), trusted), 1.0)
    edges = np.array([(i, i - s) for i in range(60) for s in (1, 2, 3) if i >= s])
    share = share_of_information(edges_of(edges), np.ones(len(edges), dtype=bool))
    inner = (edges.min(axis=1) > 5) & (edges.max(axis=1) < 54)
    np.testing.assert_allclose(share[inner], 1.0 / (1 + 4 + 9))
    far = np.vstack([edges, [[55, 3]]])
    np.testing.assert_allclose(share_of_information(edges_of(far), np.arange(len(far)) < len(edges))[-1], 1.0)
    assert share_of_information(edges_of(far), np.ones(len(far), dtype=bool))[-1] < 0.1


# --- g2o's arithmetic


def random_information(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, 6, 6))
    return A @ A.transpose(0, 2, 1) + np.diag(SIGMA**-2.0)


def test_the_cost_is_g2os_to_first_order():
    rng = np.random.default_rng(9)
    T = laps(6)
    edges = np.array([[0, 1], [1, 2], [4, 2], [5, 0]])
    measured = se3.exp(1e-4 * rng.normal(size=(4, 6))) @ between(T, edges)
    graph = Graph(T, Edges(edges, measured, random_information(rng, 4)), np.arange(6) == 0)
    for edge in graph._edges:
        edge.compute_error()
    np.testing.assert_allclose([edge.chi2() for edge in graph._edges], graph.chi2(), rtol=2e-4)


def test_derivatives_of_the_residual():
    rng = np.random.default_rng(10)
    T = laps(4)
    edges = np.array([[0, 1], [3, 1], [2, 3]])
    measured = between(T, edges)  # at zero residual, where the curvature left out vanishes
    is_fixed = np.arange(4) == 0
    graph = Graph(T, Edges(edges, measured, random_information(rng, 3)), is_fixed)
    posterior = graph.posterior(np.ones(3, dtype=bool))
    h = 1e-6
    for k in range(4):
        for i, step in enumerate(h * np.eye(6)):
            e = []
            for sign in (1.0, -1.0):
                T_kw = se3.inverse(T)
                T_kw[k] = se3.exp(sign * step) @ T_kw[k]
                graph.T_wk = se3.inverse(T_kw)
                e.append(graph.residual())
            numeric = (e[0] - e[1]) / (2.0 * h)
            analytic = sum((posterior._J[side][:, :, i] * (edges[:, side] == k)[:, None]) for side in range(2))
            np.testing.assert_allclose(numeric, analytic, atol=1e-8)
    graph.T_wk = T
    np.testing.assert_array_equal(posterior._column, [[-1, 0], [12, 0], [6, 12]])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.integers(0, 1000))
def test_information_goes_to_g2o_and_back(xi, seed):
    T = se3.exp(np.array(xi))[None]
    omega = random_information(np.random.default_rng(seed), 1)
    np.testing.assert_allclose(from_g2o_information(T, to_g2o_information(T, omega)), omega, rtol=1e-8, atol=1e-6)


# --- files


def graph_of_file(seed: int = 11):
    rng = np.random.default_rng(seed)
    T = laps(7)
    edges = np.array([[1, 0], [2, 1], [6, 2], [5, 6], [3, 2], [4, 3]])
    return T, edges, se3.exp(0.01 * rng.normal(size=(6, 6))) @ between(T, edges), random_information(rng, 6)


def test_a_file_read_is_the_graph_written(tmp_path: Path):
    T, edges, measured, information = graph_of_file()
    write_g2o(tmp_path / "a.g2o", T, edges, measured, information, is_fixed=np.arange(7) == 2)
    graph = read_g2o(tmp_path / "a.g2o")
    np.testing.assert_allclose(graph.T_wk, T, atol=1e-12)
    np.testing.assert_array_equal(graph.edge_kf, edges)
    np.testing.assert_allclose(graph.edge_T_ij, measured, atol=1e-12)
    np.testing.assert_allclose(graph.information, information, rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(graph.is_fixed, np.arange(7) == 2)
    write_g2o(tmp_path / "b.g2o", graph.T_wk, graph.edge_kf, graph.edge_T_ij, graph.information, is_fixed=graph.is_fixed)
    assert len((tmp_path / "b.g2o").read_text().splitlines()) == len((tmp_path / "a.g2o").read_text().splitlines()) == 14


def test_g2o_reads_our_file_and_finds_the_same_cost(tmp_path: Path):
    import g2opy

    T, edges, measured, information = graph_of_file()
    write_g2o(tmp_path / "a.g2o", T, edges, measured, information)
    optimizer = g2opy.SparseOptimizer()
    optimizer.set_algorithm(g2opy.OptimizationAlgorithmLevenberg(g2opy.BlockSolverSE3(g2opy.LinearSolverEigenSE3())))
    assert optimizer.load(str(tmp_path / "a.g2o"))
    assert len(optimizer.vertices()) == 7 and len(optimizer.edges()) == 6
    assert optimizer.vertices()[0].fixed() and not optimizer.vertices()[3].fixed()
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    ours = Graph(T, Edges(edges, measured, information), np.arange(7) == 0).chi2().sum()
    np.testing.assert_allclose(optimizer.active_chi2(), ours, rtol=2e-2)
    assert optimizer.save(str(tmp_path / "b.g2o"))
    again = read_g2o(tmp_path / "b.g2o")
    np.testing.assert_allclose(again.T_wk, T, atol=1e-4)  # g2o writes six digits
    order = np.lexsort(again.edge_kf.T[::-1])
    ours_order = np.lexsort(edges.T[::-1])
    np.testing.assert_array_equal(again.edge_kf[order], edges[ours_order])
    np.testing.assert_allclose(again.information[order], information[ours_order], rtol=1e-3, atol=1.0)


def test_foreign_lines_and_gaps_in_the_numbers_are_taken(tmp_path: Path):
    path = tmp_path / "a.g2o"
    path.write_text(
        "# a comment\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 30 1 0 0 0 0 0 1\n\nVERTEX_SE3:QUAT 4 0 0 0 0 0 0 2e0\n"
        "EDGE_SE3:QUAT 4 30 1 0 0 0 0 0 1 " + " ".join("1" if i in (0, 6, 11, 15, 18, 20) else "0" for i in range(21)) + "\nFIX 4 30\n"
    )
    with pytest.raises(SlamError, match="a.g2o:5.*quaternion"):
        read_g2o(path)
    path.write_text(path.read_text().replace("2e0", "1e0"))
    graph = read_g2o(path)
    np.testing.assert_array_equal(graph.vertex, [4, 30])
    np.testing.assert_array_equal(graph.edge_kf, [[0, 1]])
    assert graph.is_fixed.all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("VERTEX_SE3:QUAT 0 1 2 3", "needs 8 numbers, found 4"),
        ("VERTEX_SE3:QUAT 0 1 2 x 0 0 0 1", "not a number"),
        ("VERTEX_SE3:QUAT 0 1 2 nan 0 0 0 1", "not finite"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0", "quaternion"),
        ("VERTEX_SE3:QUAT 1.5 1 2 3 0 0 0 1", "not a number"),
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 " + "1 " * 21, "vertex 0"),
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 1", "found 10"),
        ("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 1\u00e9", "cannot be read"),
    ],
)
def test_broken_files_are_named_with_the_line(tmp_path: Path, text: str, message: str):
    path = tmp_path / "broken.g2o"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SlamError, match=message) as error:
        read_g2o(path)
    assert "broken.g2o" in str(error.value) and "\n" not in str(error.value)


def test_missing_and_empty_files(tmp_path: Path):
    with pytest.raises(SlamError, match="cannot be read"):
        read_g2o(tmp_path / "none.g2o")
    (tmp_path / "empty.g2o").write_text("")
    assert len(read_g2o(tmp_path / "empty.g2o").T_wk) == 0
