"""The pose graph of the key frames: built from the map and the closures, solved, and its result carried over to the map."""

from dataclasses import dataclass, replace

import numpy as np

from slamcli.config.options import LoopConfig
from slamcli.estimation import pose_graph
from slamcli.estimation.relative_pose_factors import Edges
from slamcli.estimation.repeated_edges import share_of_information
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.slam.loop_candidates import Candidate
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap

UNIT_SUPPORT = 100.0  # landmarks that two key frames share, for which ODOMETRY_SIGMA holds
# [m, rad]. In simulated rooms the drift over 20 to 50 key frames is a fourth to an eighth of what follows from it: a true closure must
# not be dropped where tracking was poor, and a false one is metres off.
ODOMETRY_SIGMA = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])
DEPTH_SUPPORT = 100  # landmarks that two depth images aligned are worth
MOST_SUPPORT = 300  # landmarks of a closure that count; more of them make it no more certain


@dataclass(frozen=True)
class PoseGraph:
    """Edges between key frames."""

    edges: Edges  # where the map holds them, they repeat each other
    is_closure: np.ndarray  # (E,) bool


def build(sparse_map: SparseMap, closures: list[Candidate], settings: LoopConfig) -> PoseGraph:
    """Return the edges between covisible key frames, which hold what the map says now, followed by the closures."""
    edge_kf, n_shared = covisibility_edges(sparse_map, settings)
    T_ij = product(se3.inverse(sparse_map.kf.T_wk[edge_kf[:, 0]]), sparse_map.kf.T_wk[edge_kf[:, 1]])
    support = np.append(n_shared, [float(min(c.n_inliers, MOST_SUPPORT)) for c in closures])
    edges = Edges(
        kf=np.concatenate([edge_kf, np.array([(c.kf_i, c.kf_j) for c in closures], dtype=np.int32).reshape(-1, 2)]),
        T_ij=np.concatenate([T_ij, np.array([c.T_ij for c in closures]).reshape(-1, 4, 4)]),
        information=np.diag(1.0 / (ODOMETRY_SIGMA * ODOMETRY_SIGMA)) * (support / UNIT_SUPPORT)[:, None, None],
    )
    return PoseGraph(edges, is_closure=np.arange(len(support)) >= len(edge_kf))


def covisibility_edges(sparse_map: SparseMap, settings: LoopConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of key frames (E, 2) that share landmarks or whose depth images were aligned, and how many; neighbours in time within a segment always belong."""
    edges, weights = [], []
    for i in range(1, len(sparse_map.kf)):
        shared = sparse_map.votes(sparse_map.landmarks_of(i))[:i]
        joined = np.flatnonzero(shared >= settings.edge_shared)
        before = np.flatnonzero(sparse_map.kf.segment[:i] == sparse_map.kf.segment[i])[-1:]
        on_depth = sparse_map.edge.kf[sparse_map.edge.kf[:, 0] == i, 1]
        shared[on_depth] = np.maximum(shared[on_depth], DEPTH_SUPPORT)
        joined = np.union1d(joined[np.argsort(-shared[joined], kind="stable")[: settings.edges_per_key_frame]], np.append(before, on_depth))
        edges += [(i, int(j)) for j in joined]
        weights += [max(int(shared[j]), 1) for j in joined]
    return np.array(edges, dtype=np.int32).reshape(-1, 2), np.array(weights, dtype=np.float64)


def solve(sparse_map: SparseMap, closures: list[Candidate], settings: LoopConfig) -> pose_graph.PoseGraphResult:
    """Spread the corrections of closures over the key frames; [L] (13). Drops the closures that the rest of the graph contradicts."""
    graph = build(sparse_map, closures, settings)
    is_fixed = np.zeros(len(sparse_map.kf), dtype=bool)
    is_fixed[np.unique(sparse_map.kf.segment, return_index=True)[1]] = True
    share = share_of_information(graph.edges, ~graph.is_closure)
    edges = replace(graph.edges, information=graph.edges.information * share[:, None, None])
    return pose_graph.optimize(sparse_map.kf.T_wk, edges, is_fixed=is_fixed, is_robust=graph.is_closure)


def move(sparse_map: SparseMap, T_wk: np.ndarray) -> None:
    """Move the key frames to `T_wk` and every landmark along with the key frame that created it."""
    before = sparse_map.kf.T_wk.copy()
    sparse_map.kf.T_wk[:] = T_wk
    alive = np.flatnonzero(sparse_map.lm.is_alive).astype(np.int32)
    map_adjustment.carry(sparse_map, alive, np.arange(len(sparse_map.kf)), before)
