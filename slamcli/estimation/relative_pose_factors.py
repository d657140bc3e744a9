"""Edges in bundle adjustment: relative poses of key frames that were measured besides the landmarks, as by aligning depth images.

An edge (i, j) says x_i = T_ij x_j. Its residual is e = log(T_iw T_wj T_ij^-1), its chi2 e^T Omega e, as in pose_graph.py.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.estimation.robust_loss import CHI2_95_6DOF
from slamcli.geometry import se3
from slamcli.geometry.algebra import product


@dataclass(frozen=True)
class Edges:
    """Measured relative poses."""

    kf: np.ndarray  # (E, 2) key frames i, j
    T_ij: np.ndarray  # (E, 4, 4), x_i = T_ij x_j
    information: np.ndarray  # (E, 6, 6) of the left twist of T_ij [1/m^2, 1/rad^2]

    def __len__(self) -> int:
        return len(self.kf)


NO_EDGES = Edges(np.empty((0, 2), dtype=np.int64), np.empty((0, 4, 4)), np.empty((0, 6, 6)))


def residuals(edges: Edges, T_cw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return e (E, 6) and the relative poses T_iw T_wj (E, 4, 4) that the key frames have now."""
    T_ij = product(T_cw[edges.kf[:, 0]], se3.inverse(T_cw[edges.kf[:, 1]]))
    return se3.log(product(T_ij, se3.inverse(edges.T_ij))), T_ij


class EdgeTerms:
    """What edges add to the cost and to the normal equations of a bundle problem."""

    def __init__(self, edges: Edges, place: np.ndarray, block_of: np.ndarray) -> None:
        """Take the block row `place` (K,) of each key frame, -1 = fixed, and the numbers `block_of` (n, n) of the system's blocks."""
        self._edges, self._place = edges, place[edges.kf]
        i, j = self._place.T
        is_joint = (i >= 0) & (j >= 0)
        self._joint = np.flatnonzero(is_joint)
        self._is_turned = i[is_joint] > j[is_joint]  # only blocks above the diagonal exist
        self._block = block_of[np.minimum(i, j)[is_joint], np.maximum(i, j)[is_joint]]
        self._off_diagonal = np.zeros((len(self._joint), 6, 6))

    def cost(self, T_cw: np.ndarray, robust: bool) -> float:
        """Return the sum over the edges of Huber's cost, or of chi2."""
        if len(self._edges) == 0:
            return 0.0
        chi2 = self._chi2(residuals(self._edges, T_cw)[0])
        return float(np.where(robust & (chi2 > CHI2_95_6DOF), 2.0 * np.sqrt(CHI2_95_6DOF * chi2) - CHI2_95_6DOF, chi2).sum())

    def linearize(self, T_cw: np.ndarray, robust: bool, U: np.ndarray, b_c: np.ndarray) -> None:
        """Add to the diagonal blocks U (n, 6, 6) and to minus the gradient b_c (n, 6); keep what lies off the diagonal for `add_to`."""
        if len(self._edges) == 0:
            return
        e, T_ij = residuals(self._edges, T_cw)
        chi2 = self._chi2(e)
        weight = np.where(robust & (chi2 > CHI2_95_6DOF), np.sqrt(CHI2_95_6DOF / np.maximum(chi2, CHI2_95_6DOF)), 1.0)
        # A left twist of T_iw adds to e as V^-1 does, V being the left Jacobian at e; one of T_jw, minus Ad(T_ij) times itself.
        J_i = _inverse_left_jacobian(e)
        J = (J_i, product(-J_i, se3.adjoint(T_ij)))
        weighted = [product(np.swapaxes(J_side, 1, 2), weight[:, None, None] * self._edges.information) for J_side in J]
        for side in range(2):
            free = self._place[:, side] >= 0
            place = self._place[free, side]
            np.add.at(U, place, product(weighted[side][free], J[side][free]))
            np.add.at(b_c, place, -np.einsum("eij,ej->ei", weighted[side][free], e[free]))
        blocks = product(weighted[0][self._joint], J[1][self._joint])
        self._off_diagonal = np.where(self._is_turned[:, None, None], np.swapaxes(blocks, 1, 2), blocks)

    def add_to(self, blocks: np.ndarray) -> None:
        """Add to the blocks (B, 6, 6) of the reduced camera system that lie off the diagonal."""
        np.add.at(blocks, self._block, self._off_diagonal)

    def _chi2(self, e: np.ndarray) -> np.ndarray:
        return np.einsum("ei,eij,ej->e", e, self._edges.information, e)


def _inverse_left_jacobian(e: np.ndarray) -> np.ndarray:
    """Return the inverse left Jacobian (E, 6, 6) of SE(3) at e (E, 6), to the second order: edges that fit have small residuals.

    T. Barfoot, State Estimation for Robotics, 2017, equation (7.98), with Bernoulli numbers 1, -1/2, 1/6.
    """
    ad = np.zeros((len(e), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = se3.hat(e[:, 3:])
    ad[:, :3, 3:] = se3.hat(e[:, :3])
    return np.eye(6) - 0.5 * ad + product(ad, ad) / 12.0
