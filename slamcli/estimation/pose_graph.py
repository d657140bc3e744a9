"""Robust SE(3) pose graph, solved with g2o.

An edge (i, j) with T_ij says x_i = T_ij x_j; its information belongs to the left twist xi = (rho, phi) of T_ij, that is to
T_ij_true = exp(xi) T_ij. The cost is F = sum w e^T Omega e with e = log(T_iw T_wj T_ij^-1), [L] (13), and w = 1 for trusted edges.

Trusted edges that hold what one map says repeat each other: ten edges per key frame, taken as independent, would make the chain of key
frames twenty times stiffer than its drift is. Unless told that they are independent, they share the information of the strongest.

Robust edges carry truncated least squares: an edge is kept, at the cost of its chi2, or dropped, at the cost of a fixed limit. Which is
better is not seen from an edge's own residual, as one false edge bends a long chain until its own residual is small. So edges are tested
by how much the cost of the whole graph falls without them, one by one and by groups that claim the same revisit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from slamcli.estimation.pose_graph_solver import Graph
from slamcli.estimation.robust_loss import CHI2_99_6DOF
from slamcli.geometry.algebra import product, pseudo_inverse, solve

GROUP_SPAN = 10  # closures whose ends both lie within so many key frames of each other's claim the same revisit
GROUP_MAX = 30  # more are a lap, not a revisit
GNC_GROWTH = 2.0  # of the control parameter per round
CHAIN_SPAN = 20  # key frames; an edge across more is no part of the chain in time


@dataclass(frozen=True)
class PoseGraphResult:
    """The poses and what each edge thinks of them."""

    T_wk: np.ndarray  # (K, 4, 4)
    chi2: np.ndarray  # (E,) e^T Omega e at the result, of dropped edges too
    is_kept: np.ndarray  # (E,) bool, False where a robust edge was dropped
    cost: float  # sum of chi2 over the edges kept
    iterations: int


def optimize(
    T_wk: np.ndarray,
    edge_kf: np.ndarray,
    edge_T_ij: np.ndarray,
    information: np.ndarray,
    *,
    is_fixed: np.ndarray,
    is_robust: np.ndarray | None = None,
    is_independent: bool | None = None,
    iterations: int = 20,
    chi2_limit: float = CHI2_99_6DOF,
) -> PoseGraphResult:
    """Find the poses that agree best with the edges, dropping robust edges that the rest of the graph contradicts.

    T_wk : (K, 4, 4) start; edge_kf : (E, 2) rows i, j; edge_T_ij : (E, 4, 4); information : (E, 6, 6); is_fixed : (K,) bool, at least
    one; is_robust : (E,) bool, edges that may be dropped; is_independent : whether parallel trusted edges were measured
    independently, None = where no edge is robust; chi2_limit : what dropping an edge costs

    First graduated non-convexity, which finds the consensus of many edges from any start (H. Yang et al., Graduated Non-Convexity for
    Robust Spatial Perception, RA-L 2020, doi:10.1109/LRA.2020.2965893), then data snooping (W. Baarda, A Testing Procedure for Use in
    Geodetic Networks, 1968): drop or readmit while that lowers the cost.
    """
    is_fixed = np.asarray(is_fixed, dtype=bool)
    if not is_fixed.any():
        raise ValueError("a pose graph needs a fixed key frame")
    is_independent = is_robust is None if is_independent is None else is_independent
    is_robust = np.zeros(len(edge_kf), dtype=bool) if is_robust is None else np.asarray(is_robust, dtype=bool)
    if not is_independent:
        information = np.asarray(information) * share_of_information(edge_kf, information, ~is_robust)[:, None, None]
    graph = Graph(T_wk, edge_kf, edge_T_ij, information, is_fixed)
    total = graph.run(iterations) if len(edge_kf) else 0
    is_kept = np.ones(len(graph.edge_kf), dtype=bool)
    if is_robust.any():
        total += _graduate(graph, is_robust, chi2_limit)
        is_kept = ~is_robust | (graph.chi2() <= chi2_limit)
        # Many false edges at once can fold the graph up, from where no iteration finds back.
        graph.restart(T_wk)
        total += graph.run(iterations, is_kept)
        is_kept, more = _snoop(graph, is_robust, is_kept, chi2_limit, iterations)
        total += more
    chi2 = graph.chi2()
    return PoseGraphResult(T_wk=graph.T_wk, chi2=chi2, is_kept=is_kept, cost=float(chi2[is_kept].sum()), iterations=total)


def share_of_information(edge_kf: np.ndarray, information: np.ndarray, is_trusted: np.ndarray) -> np.ndarray:
    """Return the share (E,) of its information that each edge may claim when trusted edges repeat each other, 1 for other edges.

    Stretch the chain of key frames evenly: an edge of weight w over s steps is stretched s times as far as one step and so resists, per
    step, like w s single edges. Over every cut between neighbours, all edges together may resist like one edge of the largest weight.
    """
    ends = np.sort(np.asarray(edge_kf, dtype=np.int64).reshape(-1, 2), axis=1)
    weight = np.trace(np.asarray(information).reshape(-1, 6, 6), axis1=1, axis2=2)
    span = ends[:, 1] - ends[:, 0]
    is_chain = np.asarray(is_trusted, dtype=bool) & (span >= 1) & (span <= CHAIN_SPAN)
    n_cuts = int(ends.max(initial=0)) + 1
    stiffness, strongest = np.zeros(n_cuts), np.zeros(n_cuts)
    for step in range(CHAIN_SPAN):
        crossing = is_chain & (span > step)
        np.add.at(stiffness, ends[crossing, 0] + step, (weight * span)[crossing])
        np.maximum.at(strongest, ends[crossing, 0] + step, weight[crossing])
    per_cut = np.divide(strongest, stiffness, out=np.ones(n_cuts), where=stiffness > 0.0)
    mean = np.append(0.0, np.cumsum(per_cut))
    share = np.ones(len(ends))
    share[is_chain] = (mean[ends[is_chain, 1]] - mean[ends[is_chain, 0]]) / span[is_chain]
    across = np.asarray(is_trusted, dtype=bool) & ~is_chain
    share[across] = 0.5 * (per_cut[ends[across, 0]] + per_cut[np.maximum(ends[across, 1] - 1, 0)])
    return share


def _graduate(graph: Graph, is_robust: np.ndarray, limit: float) -> int:
    """Run graduated non-convexity on the truncated quadratic, from nearly convex to sharp; weights of robust edges only."""
    worst = graph.chi2()[is_robust].max()
    if worst <= limit:
        return 0
    mu, total = limit / (2.0 * worst - limit), 0
    weight = np.ones(len(is_robust))
    while mu < 1e4:
        chi2 = graph.chi2()[is_robust]
        low, high = mu / (mu + 1.0) * limit, (mu + 1.0) / mu * limit
        with np.errstate(divide="ignore"):
            between = np.sqrt(limit * mu * (mu + 1.0) / chi2) - mu
        new = np.where(chi2 <= low, 1.0, np.where(chi2 >= high, 0.0, between))
        weight[is_robust] = new
        total += graph.run(3, weight)
        if ((new == 0.0) | (new == 1.0)).all():
            break
        mu *= GNC_GROWTH
    return total


def _snoop(graph: Graph, is_robust: np.ndarray, is_kept: np.ndarray, limit: float, iterations: int) -> tuple[np.ndarray, int]:
    """Drop or readmit edges and groups of edges, the most rewarding first, while that lowers the truncated cost."""
    edges = np.flatnonzero(is_robust)
    claims = _claims(graph.edge_kf[edges])
    total = 0
    for _ in range(2 * len(claims)):
        covariance = graph.posterior(is_kept).covariance(edges)
        residual, information = graph.residual()[edges], graph.information[edges]
        gains = [_gain(residual, information, covariance, members, is_kept[edges[members]], limit) for members in claims]
        best = int(np.argmax(gains))
        if gains[best] <= 0.0:
            break
        members = edges[claims[best]]
        is_kept = is_kept.copy()
        is_kept[members] = not is_kept[members].any()
        total += graph.run(iterations, is_kept)
    return is_kept, total


def _claims(ends: np.ndarray) -> list[np.ndarray]:
    """Return the sets of robust edges (E, 2) that are tested together: each alone, and each group that claims one revisit."""
    ends = np.sort(ends, axis=1)
    near = (np.abs(ends[:, None] - ends[None, :]) <= GROUP_SPAN).all(axis=2)
    _, label = connected_components(near, directed=False)
    groups = [np.flatnonzero(label == g) for g in range(label.max() + 1)]
    return [np.array([m]) for m in range(len(ends))] + [g for g in groups if 1 < len(g) <= GROUP_MAX]


def _gain(
    residual: np.ndarray, information: np.ndarray, covariance: np.ndarray, members: np.ndarray, kept: np.ndarray, limit: float
) -> float:
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
        return float(product(r, pseudo_inverse(C - P, rcond=1e-9), r)) - limit * len(members)
    return limit * len(members) - float(product(r, solve(C + P, r)))
