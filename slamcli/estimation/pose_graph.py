"""Robust SE(3) pose graph, solved with g2o.

An edge (i, j) with T_ij says x_i = T_ij x_j; its information belongs to the left twist xi = (rho, phi) of T_ij, that is to
T_ij_true = exp(xi) T_ij. The cost is F = sum w e^T Omega e with e = log(T_iw T_wj T_ij^-1), [L] (13), and w = 1 for trusted edges.

Robust edges carry truncated least squares: an edge is kept, at the cost of its chi2, or dropped, at the cost of a fixed limit. Which is
better is not seen from an edge's own residual, as one false edge bends a long chain until its own residual is small. So edges are tested
by how much the cost of the whole graph falls without them, one by one and by groups that claim the same revisit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from slamcli.estimation.pose_graph_solver import Graph
from slamcli.estimation.relative_pose_factors import Edges
from slamcli.estimation.robust_loss import CHI2_99_6DOF
from slamcli.geometry.algebra import product, pseudo_inverse, solve

DROP_CHI2 = CHI2_99_6DOF  # what dropping an edge costs
ITERATIONS = 20  # at most, until the cost changes no more
GROUP_SPAN = 10  # closures whose ends both lie within so many key frames of each other's claim the same revisit
GROUP_MAX = 30  # more are a lap, not a revisit
GNC_GROWTH, GNC_SHARP = 2.0, 1e4  # of the control parameter per round, and its value at which the loss is as good as truncated
GNC_ITERATIONS = 3  # per round: the next one changes the weights anyway
LEAST_EIGENVALUE = 1e-9  # of the largest: what a dropped set leaves undetermined counts as 0


@dataclass(frozen=True)
class PoseGraphResult:
    """The poses and what each edge thinks of them."""

    T_wk: np.ndarray  # (K, 4, 4)
    chi2: np.ndarray  # (E,) e^T Omega e at the result, of dropped edges too
    is_kept: np.ndarray  # (E,) bool, False where a robust edge was dropped
    cost: float  # sum of chi2 over the edges kept
    iterations: int


def optimize(T_wk: np.ndarray, edges: Edges, *, is_fixed: np.ndarray, is_robust: np.ndarray | None = None) -> PoseGraphResult:
    """Find the poses that agree best with the edges, dropping robust edges that the rest of the graph contradicts.

    T_wk : (K, 4, 4) start; edges : independent of each other, see `repeated_edges` for those that are not
    is_fixed : (K,) bool, at least one; is_robust : (E,) bool, edges that may be dropped

    First graduated non-convexity, which finds the consensus of many edges from any start (H. Yang et al., Graduated Non-Convexity for
    Robust Spatial Perception, RA-L 2020, doi:10.1109/LRA.2020.2965893), then data snooping (W. Baarda, A Testing Procedure for Use in
    Geodetic Networks, 1968): drop or readmit while that lowers the cost.
    """
    is_fixed = np.asarray(is_fixed, dtype=bool)
    if not is_fixed.any():
        raise ValueError("a pose graph needs a fixed key frame")
    is_robust = np.zeros(len(edges), dtype=bool) if is_robust is None else np.asarray(is_robust, dtype=bool)
    graph = Graph(T_wk, edges, is_fixed)
    total = graph.run(ITERATIONS) if len(edges) else 0
    is_kept = np.ones(len(edges), dtype=bool)
    if is_robust.any():
        total += _graduate(graph, is_robust)
        is_kept = ~is_robust | (graph.chi2() <= DROP_CHI2)
        # Many false edges at once can fold the graph up, from where no iteration finds back.
        graph.restart(T_wk)
        total += graph.run(ITERATIONS, is_kept)
        is_kept, more = _snoop(graph, is_robust, is_kept)
        total += more
    chi2 = graph.chi2()
    return PoseGraphResult(T_wk=graph.T_wk, chi2=chi2, is_kept=is_kept, cost=float(chi2[is_kept].sum()), iterations=total)


def _graduate(graph: Graph, is_robust: np.ndarray) -> int:
    """Run graduated non-convexity on the truncated quadratic, from nearly convex to sharp; weights of robust edges only."""
    worst, limit = graph.chi2()[is_robust].max(), DROP_CHI2
    if worst <= limit:
        return 0
    mu, total = limit / (2.0 * worst - limit), 0
    weight = np.ones(len(is_robust))
    while mu < GNC_SHARP:
        chi2 = graph.chi2()[is_robust]
        low, high = mu / (mu + 1.0) * limit, (mu + 1.0) / mu * limit
        with np.errstate(divide="ignore"):
            between = np.sqrt(limit * mu * (mu + 1.0) / chi2) - mu
        new = np.where(chi2 <= low, 1.0, np.where(chi2 >= high, 0.0, between))
        weight[is_robust] = new
        total += graph.run(GNC_ITERATIONS, weight)
        if ((new == 0.0) | (new == 1.0)).all():
            break
        mu *= GNC_GROWTH
    return total


def _snoop(graph: Graph, is_robust: np.ndarray, is_kept: np.ndarray) -> tuple[np.ndarray, int]:
    """Drop or readmit edges and groups of edges, the most rewarding first, while that lowers the truncated cost."""
    edges = np.flatnonzero(is_robust)
    claims = _claims(graph.edges.kf[edges])
    total = 0
    for _ in range(2 * len(claims)):
        covariance = graph.posterior(is_kept).covariance(edges)
        residual, information = graph.residual()[edges], graph.edges.information[edges]
        gains = [_gain(residual, information, covariance, members, is_kept[edges[members]]) for members in claims]
        best = int(np.argmax(gains))
        if gains[best] <= 0.0:
            break
        members = edges[claims[best]]
        is_kept = is_kept.copy()
        is_kept[members] = not is_kept[members].any()
        total += graph.run(ITERATIONS, is_kept)
    return is_kept, total


def _claims(ends: np.ndarray) -> list[np.ndarray]:
    """Return the sets of robust edges (E, 2) that are tested together: each alone, and each group that claims one revisit."""
    ends = np.sort(ends, axis=1)
    near = (np.abs(ends[:, None] - ends[None, :]) <= GROUP_SPAN).all(axis=2)
    _, label = connected_components(near, directed=False)
    groups = [np.flatnonzero(label == g) for g in range(label.max() + 1)]
    return [np.array([m]) for m in range(len(ends))] + [g for g in groups if 1 < len(g) <= GROUP_MAX]


def _gain(residual: np.ndarray, information: np.ndarray, covariance: np.ndarray, members: np.ndarray, kept: np.ndarray) -> float:
    """Return by how much the truncated cost falls when a set of edges changes sides, to first order; -inf for a set on both sides.

    With the residual r of the set, the covariance C of its measurements and P of the graph's prediction, the cost of graph and set
    falls by r^T (C - P)^-1 r when the set is dropped, and rises by r^T (C + P)^-1 r when it is taken in.
    """
    if kept.any() != kept.all():
        return -np.inf
    rows = (6 * members[:, None] + np.arange(6)).ravel()
    r, P = residual[members].ravel(), covariance[np.ix_(rows, rows)]
    C = np.zeros_like(P)
    for k, block in enumerate(pseudo_inverse(information[members])):
        C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
    if kept.all():
        return float(product(r, pseudo_inverse(C - P, rcond=LEAST_EIGENVALUE), r)) - DROP_CHI2 * len(members)
    return DROP_CHI2 * len(members) - float(product(r, solve(C + P, r)))
