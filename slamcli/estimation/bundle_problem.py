"""The problem that bundle adjustment solves: observations and edges, their cost, and the normal equations of a Gauss-Newton step.

With the key frames' twists dx_c and the landmarks' shifts dx_l, the normal equations are, by blocks,

    [U   W^T] [dx_c]   [b_c]
    [W   V  ] [dx_l] = [b_l]

V is block diagonal, so landmarks are eliminated: (U - W^T V^-1 W) dx_c = b_c - W^T V^-1 b_l is the reduced camera system, and
dx_l = V^-1 (b_l - W dx_c). The names are those of B. Triggs et al. 2000, doi:10.1007/3-540-44480-7_21, section 6.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamcli.estimation import bundle_kernels as kernels
from slamcli.estimation.bundle_kernels import NormalEquations, ReducedBlocks, SharedGradient, Sightings, Variables
from slamcli.estimation.reduced_camera_system import order_and_blocks
from slamcli.estimation.relative_pose_factors import NO_EDGES, Edges, EdgeTerms
from slamcli.estimation.robust_loss import CHI2_95_2DOF, CHI2_95_3DOF, HUBER, Huber
from slamcli.geometry.camera import Camera

FEW_OBSERVATIONS = 12  # a key frame with fewer is held back, as its pose may be undetermined
HOLD = 1.0 / 0.02**2  # [1/m^2, 1/rad^2] added to its diagonal in every iteration: steps get shorter, the optimum stays
PREDICTED, INV_SIGMA_PX, INV_SIGMA_Z = slice(0, 3), 3, 4  # columns of `measured`: u, v [px], depth [m], and what they are weighed by


@dataclass(frozen=True)
class Observations:
    """Landmarks seen by key frames, sorted by landmark, with what was measured and how well."""

    kf: np.ndarray  # (O,) key frame
    lm: np.ndarray  # (O,) landmark, not decreasing
    xy: np.ndarray  # (O, 2) px, undistorted
    depth: np.ndarray  # (O,) m, NaN = bearing only
    sigma_px: np.ndarray  # (O,) px, standard deviation
    sigma_z: np.ndarray  # (O,) m, standard deviation, NaN where depth is

    def __len__(self) -> int:
        return len(self.kf)


class Step(NamedTuple):
    """A damped Gauss-Newton step."""

    to: Variables
    decrease: float  # of the cost, as the linearized problem foretells it; NaN where its system is not positive definite


class Problem:
    """A bundle adjustment problem with its loss, the start, and the work space of its normal equations.

    start : Variables, those given; a landmark that is not finite is at 0, where nothing observes it
    order : (O,) the observation given that each one here is; here they are sorted by landmark and block row
    measured : (O, 5) see `bundle_kernels`; place : (K,) the block row of each key frame, -1 = fixed
    hold : (n,) added to the diagonal of key frames that few observations determine
    normal : the normal equations, after `linearize`; system, rhs, V_inv : the reduced camera system, after `eliminate`
    """

    def __init__(
        self,
        start: Variables,
        seen: Observations,
        camera: Camera,
        *,
        is_fixed: np.ndarray,
        edges: Edges = NO_EDGES,
        loss: Huber = HUBER,
    ) -> None:
        """Take a start, which is copied, and what is known of it; raises ValueError where the observations are not sorted by landmark.

        start : T_cw (K, 4, 4), x_w (L, 3) [m]; is_fixed : (K,) bool, key frames that stay
        edges : relative poses of key frames that were measured besides
        """
        obs_kf, obs_lm = np.asarray(seen.kf, dtype=np.int64), np.asarray(seen.lm, dtype=np.int64)
        if (np.diff(obs_lm) < 0).any():
            raise ValueError("observations must be sorted by landmark")
        x = np.array(start.x_w, dtype=np.float64, order="C").reshape(-1, 3)
        self.is_finite_landmark = np.all(np.isfinite(x), axis=1)
        x[~self.is_finite_landmark] = 0.0  # NaN would spread
        self.start = Variables(np.array(start.T_cw, dtype=np.float64, order="C"), x)
        n_kf = len(self.start.T_cw)
        measured = _measurements(seen, self.is_finite_landmark[obs_lm])
        n_seen = np.bincount(obs_kf[measured[:, INV_SIGMA_PX] > 0.0], minlength=n_kf)
        n_seen += FEW_OBSERVATIONS * np.bincount(edges.kf.ravel(), minlength=n_kf)  # an edge determines a pose by itself
        free = np.flatnonzero(~np.asarray(is_fixed, dtype=bool) & (n_seen > 0))
        self.place, self.system = order_and_blocks(free, obs_kf, obs_lm, n_kf, edges.kf)
        self.hold = np.zeros(len(free))
        self.hold[self.place[free]] = np.where(n_seen[free] < FEW_OBSERVATIONS, HOLD, 0.0)
        self._edge_terms = EdgeTerms(edges, self.place, self.system.block_of)
        offset = np.searchsorted(obs_lm, np.arange(len(x) + 1)).astype(np.int64)
        self.order = _stable_order(obs_lm * (n_kf + 1) + self.place[obs_kf] + 1)
        self.measured = measured[self.order]
        self._seen = Sightings(obs_kf[self.order].astype(np.uint64), offset, self.place)
        self._camera = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64)
        self._loss, self._limits = loss, np.array(loss, dtype=np.float64)
        self.normal = NormalEquations.empty(len(free), len(x), len(obs_kf))
        self.rhs, self.V_inv = np.empty((len(free), 6)), np.empty((len(x), 6))
        self._scratch = np.empty((int(np.diff(offset).max(initial=0)), 3, 6))

    # -- cost ---------------------------------------------------------------------------------------------------------------------

    def cost(self, at: Variables) -> float:
        """Return the sum of the loss over observations and edges."""
        return self._evaluate(at, self._limits)[0] + self._edge_terms.cost(at.T_cw, self._loss.is_robust)

    def chi2(self, at: Variables) -> np.ndarray:
        """Return chi2 (O,), inf where switched off or behind the camera."""
        chi2 = self._evaluate(at, np.array([np.inf, np.inf]))[1]
        return np.where((self.measured[:, INV_SIGMA_PX] == 0.0) | (chi2 >= kernels.CHI2_BEHIND), np.inf, chi2)

    def is_inlier(self, chi2: np.ndarray) -> np.ndarray:
        """Say of each observation (O,) whether its chi2 is within the 95 % quantile of its number of residuals."""
        return chi2 <= np.where(self.measured[:, INV_SIGMA_Z] > 0.0, CHI2_95_3DOF, CHI2_95_2DOF)

    def predict(self, at: Variables) -> np.ndarray:
        """Project the landmarks into the key frames that see them, (O, 3) u, v [px], depth [m]."""
        lm = np.repeat(np.arange(len(at.x_w)), np.diff(self._seen.offset))
        T_of = at.T_cw[self._seen.kf.astype(np.int64)]
        x_c = np.einsum("oij,oj->oi", T_of[:, :3, :3], at.x_w[lm]) + T_of[:, :3, 3]
        z = np.maximum(x_c[:, 2], kernels.Z_MIN)
        fx, fy, cx, cy = self._camera
        return np.stack([fx * x_c[:, 0] / z + cx, fy * x_c[:, 1] / z + cy, z], axis=1)

    def in_given_order(self, values: np.ndarray) -> np.ndarray:
        """Undo the reordering of the observations."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    def _evaluate(self, at: Variables, limits: np.ndarray) -> tuple[float, np.ndarray]:
        chi2 = np.empty(len(self._seen.kf))
        return kernels.evaluate(at, self._seen, self.measured, self._camera, limits, chi2), chi2

    # -- a step -------------------------------------------------------------------------------------------------------------------

    def linearize(self, at: Variables, *, measured: np.ndarray | None = None) -> None:
        """Fill the normal equations; `measured` (O, 5) stands in for what was measured."""
        self.normal.clear()
        measured = self.measured if measured is None else measured
        kernels.linearize(at, self._seen, measured, self._camera, self._limits, self.normal)
        self._edge_terms.linearize(at.T_cw, self._loss.is_robust, self.normal.U, self.normal.b_c)

    def eliminate(self, damping: float, hold: np.ndarray) -> None:
        """Fill the reduced camera system from the normal equations.

        damping : factor on their diagonal (Marquardt); hold : (n,) added to the key frames'
        """
        self.system.blocks.fill(0.0)
        reduced = ReducedBlocks(self.system.block_of, self.system.blocks, self.rhs, self.V_inv, self._scratch)
        kernels.eliminate(self.normal, self._seen, damping, hold, reduced)
        self._edge_terms.add_to(self.system.blocks)

    def shared_gradients(self, used: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute J_map^T w J of numbers that all observations share: what eliminating the landmarks leaves of it, and the landmarks' part.

        used (O, 5) : what was measured, as in `measured`; columns : (O, 3, G) of J, the growth of u, v [px], depth [m] per unit of each number
        Returns (G, 6 n) and (G, L, 3), at the start, where the problem is to be linearized and its landmarks eliminated.
        """
        per_number = np.ascontiguousarray(columns.transpose(2, 0, 1))
        reduced, lifted = np.zeros((len(per_number), *self.rhs.shape)), np.zeros((len(per_number), *self.normal.b_l.shape))
        for g, column in enumerate(per_number):
            to = SharedGradient(reduced[g], lifted[g])
            kernels.shared_gradient(self.start, self._seen, used, self._camera, column, self.normal.W, self.V_inv, to)
        return reduced.reshape(len(reduced), -1), lifted

    def step(self, at: Variables, damping: float) -> Step:
        """Solve the damped normal equations of a linearized problem, and take the step from where it was linearized."""
        self.eliminate(damping, self.hold)
        factor = self.system.factorize()
        if factor is None:
            return Step(at, np.nan)
        dx_c = factor.solve(self.rhs.ravel()).reshape(-1, 6)
        to = Variables(np.empty_like(at.T_cw), np.empty_like(at.x_w))
        return Step(to, kernels.step(at, self.normal, self.V_inv, self._seen, damping, self.hold, dx_c, to))


def _stable_order(key: np.ndarray) -> np.ndarray:
    """Sort, which costs, only what is not sorted."""
    return np.arange(len(key)) if (key[1:] >= key[:-1]).all() else np.argsort(key, kind="stable")


def _measurements(seen: Observations, is_finite_landmark: np.ndarray) -> np.ndarray:
    """Join what was measured to rows (O, 5) u, v, depth, 1 / sigma_px, 1 / sigma_z, with 0 for what is missing or not finite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inv_px, inv_z = 1.0 / np.asarray(seen.sigma_px, dtype=np.float64), 1.0 / np.asarray(seen.sigma_z, dtype=np.float64)
    xy, depth = np.asarray(seen.xy, dtype=np.float64).reshape(-1, 2), np.asarray(seen.depth, dtype=np.float64)
    is_valid = np.isfinite(xy[:, 0]) & np.isfinite(xy[:, 1]) & np.isfinite(inv_px) & is_finite_landmark
    has_depth = is_valid & np.isfinite(depth) & np.isfinite(inv_z)
    columns = ((xy[:, 0], is_valid), (xy[:, 1], is_valid), (depth, has_depth), (inv_px, is_valid), (inv_z, has_depth))
    return np.stack([np.where(is_given, column, 0.0) for column, is_given in columns], axis=1)
