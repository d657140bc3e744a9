"""A weighted SE(3) pose graph in g2o, with its residuals and their covariance."""

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import SuperLU, splu

from slamcli.estimation.relative_pose_factors import Edges
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.g2o_convention import to_g2o_information

COLUMNS_AT_ONCE = 240  # of the covariance solved for
CONVERGED = 1e-6  # share of the cost by which the last iteration changes it
ROUNDING = 1e-9  # share of a cost or of a diagonal entry that the digits of g2o and of the factorization do not hold
AS_GOOD_AS_FREE = 1e-6  # [1/m^2, 1/rad^2] a pose known to 1 km, 1000 rad


class Graph:
    """The graph in g2o, with weights on its edges."""

    def __init__(self, T_wk: np.ndarray, edges: Edges, is_fixed: np.ndarray) -> None:
        """Take the poses (K, 4, 4) to start from, and the key frames (K,) that stay; every edge weighs 1."""
        import g2opy

        self.T_wk, self.edges, self.is_fixed = np.array(T_wk, dtype=np.float64), edges, is_fixed
        self._information_g2o = to_g2o_information(edges.T_ij, edges.information)
        self._weight = np.ones(len(edges))
        self._optimizer = g2opy.SparseOptimizer()
        self._vertices, self._edges = [], []
        for k, T in enumerate(self.T_wk):
            vertex = g2opy.VertexSE3()
            vertex.set_id(k)
            vertex.set_estimate(g2opy.Isometry3d(T))
            vertex.set_fixed(bool(is_fixed[k]))
            self._optimizer.add_vertex(vertex)
            self._vertices.append(vertex)
        for (i, j), T, omega in zip(edges.kf.tolist(), edges.T_ij, self._information_g2o, strict=True):
            edge = g2opy.EdgeSE3()
            edge.set_vertex(0, self._vertices[i])
            edge.set_vertex(1, self._vertices[j])
            edge.set_measurement(g2opy.Isometry3d(T))
            edge.set_information(omega)
            self._optimizer.add_edge(edge)
            self._edges.append(edge)

    def run(self, iterations: int, weight: np.ndarray | None = None) -> int:
        """Minimize under weights (E,); return the number of iterations, at most so many."""
        import g2opy

        weight = np.ones(len(self._edges)) if weight is None else np.array(weight, dtype=np.float64)
        for e in np.flatnonzero(weight != self._weight):
            self._edges[e].set_information(weight[e] * self._information_g2o[e])
        self._weight = weight
        # From dead reckoning, Gauss-Newton is there in three iterations where g2o's Levenberg-Marquardt, whose damping follows the
        # largest entry of the diagonal, takes twenty. It fails where a part of the graph hangs on nothing.
        done, is_better = self._iterate(g2opy.OptimizationAlgorithmGaussNewton, iterations)
        if not is_better:
            done += self._iterate(g2opy.OptimizationAlgorithmLevenberg, iterations)[0]
        self.T_wk = np.array([vertex.estimate().matrix() for vertex in self._vertices])
        return done

    def restart(self, T_wk: np.ndarray) -> None:
        """Go on from poses `T_wk` (K, 4, 4)."""
        import g2opy

        self.T_wk = np.array(T_wk, dtype=np.float64)
        for vertex, T in zip(self._vertices, self.T_wk, strict=True):
            vertex.set_estimate(g2opy.Isometry3d(T))

    def _iterate(self, algorithm, iterations: int) -> tuple[int, bool]:
        """Iterate until the cost changes no more; say whether it is no higher than before, and go back if it is."""
        import g2opy

        self._optimizer.set_algorithm(algorithm(g2opy.BlockSolverSE3(g2opy.LinearSolverEigenSE3())))
        self._optimizer.initialize_optimization()
        start = cost = self._cost()
        done, before = 0, np.inf
        while done < iterations and abs(before - cost) > CONVERGED * cost:
            done += 1
            before, cost = cost, self._cost() if self._optimizer.optimize(1) == 1 else np.inf
        is_better = cost <= start * (1.0 + ROUNDING) + ROUNDING
        if not is_better:
            self.restart(self.T_wk)
        return done, is_better

    def _cost(self) -> float:
        self._optimizer.compute_active_errors()
        return self._optimizer.active_chi2()

    def residual(self) -> np.ndarray:
        """Return e (E, 6) = log(T_iw T_wj T_ij^-1)."""
        i, j = self.edges.kf.T
        return se3.log(product(se3.inverse(self.T_wk[i]), self.T_wk[j], se3.inverse(self.edges.T_ij)))

    def chi2(self) -> np.ndarray:
        """Return e^T Omega e (E,)."""
        e = self.residual()
        return np.einsum("ei,eij,ej->e", e, self.edges.information, e)

    def posterior(self, is_kept: np.ndarray) -> "Posterior":
        """Factorize the information that the edges kept give."""
        return Posterior(self, is_kept)


class Posterior:
    """What the edges kept leave uncertain. SuperLU's last digits follow the processor; they bear only on which edges are kept."""

    def __init__(self, graph: Graph, is_kept: np.ndarray) -> None:
        # e = log(T_iw T_wj T_ij^-1). A left twist of T_iw adds to e as it is; one of T_jw adds minus Ad(T_iw T_wj) times itself. The
        # curvature of log is left out, as residuals are small.
        place = np.where(graph.is_fixed, -1, 6 * (np.cumsum(~graph.is_fixed) - 1))
        i, j = graph.edges.kf.T
        self._column = place[graph.edges.kf]
        self._J = (np.broadcast_to(np.eye(6), (len(i), 6, 6)), -se3.adjoint(product(se3.inverse(graph.T_wk[i]), graph.T_wk[j])))
        self._n = 6 * int((~graph.is_fixed).sum())
        self._factor = self._factorize(graph.edges.information, is_kept)

    def _factorize(self, information: np.ndarray, is_kept: np.ndarray) -> SuperLU:
        rows, columns, values = [], [], []
        for a in range(2):
            for b in range(2):
                use = is_kept & (self._column[:, a] >= 0) & (self._column[:, b] >= 0)
                block = product(np.swapaxes(self._J[a][use], 1, 2), information[use], self._J[b][use])
                row = self._column[use, a][:, None, None] + np.arange(6)[:, None]
                column = self._column[use, b][:, None, None] + np.arange(6)
                rows.append(np.broadcast_to(row, block.shape).ravel())
                columns.append(np.broadcast_to(column, block.shape).ravel())
                values.append(block.ravel())
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        H = coo_array(entries, shape=(self._n, self._n)).tocsc()
        # Key frames that hang on nothing fixed would make it singular.
        H.setdiag(H.diagonal() * (1.0 + ROUNDING) + AS_GOOD_AS_FREE)
        return splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def covariance(self, edges: np.ndarray) -> np.ndarray:
        """Return the joint covariance (6 m, 6 m) of what the graph predicts for the relative poses of m edges."""
        J = self._rows(edges)
        out = np.empty((J.shape[0], J.shape[0]))
        for first in range(0, len(out), COLUMNS_AT_ONCE):
            columns = slice(first, first + COLUMNS_AT_ONCE)
            out[:, columns] = J @ self._factor.solve(np.ascontiguousarray(J[columns].toarray().T))
        return out

    def _rows(self, edges: np.ndarray) -> csr_array:
        """Return the derivatives (6 m, n) of the relative poses of m edges."""
        rows, columns, values = [], [], []
        for side in range(2):
            use = self._column[edges, side] >= 0
            block = self._J[side][edges[use]]
            rows.append(np.broadcast_to(6 * np.flatnonzero(use)[:, None, None] + np.arange(6)[:, None], block.shape).ravel())
            columns.append(np.broadcast_to(self._column[edges[use], side][:, None, None] + np.arange(6), block.shape).ravel())
            values.append(block.ravel())
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return csr_array(entries, shape=(6 * len(edges), self._n))
