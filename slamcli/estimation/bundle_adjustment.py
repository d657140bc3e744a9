"""Bundle adjustment: key-frame poses and landmarks together, by Levenberg-Marquardt with the landmarks eliminated.

B. Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, doi:10.1007/3-540-44480-7_21; [Z] 1.2, [L] 1.2.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.estimation import bundle_kernels as kernels
from slamcli.estimation.camera_pose import CHI2_95_2DOF, CHI2_95_3DOF
from slamcli.estimation.reduced_camera_system import Factor, order_and_blocks
from slamcli.estimation.relative_pose_factors import NO_EDGES, Edges, EdgeTerms
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera

DAMPING_START, DAMPING_MIN, DAMPING_MAX = 1e-5, 1e-9, 1e8
FEW_OBSERVATIONS = 12  # a key frame with fewer is held back, as its pose may be undetermined
HOLD = 1.0 / 0.02**2  # [1/m^2, 1/rad^2] added to its diagonal in every iteration: steps get shorter, the optimum stays


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


@dataclass(frozen=True)
class BundleResult:
    """The adjusted poses and landmarks and the evidence for them."""

    T_cw: np.ndarray  # (K, 4, 4)
    x_w: np.ndarray  # (L, 3) m
    cost: list[float]  # sum of Huber's costs of the observations in use, at the start and after every accepted iteration
    chi2: np.ndarray  # (O,) at the result, also of outliers; inf where the landmark is behind the camera or a value is not finite
    is_inlier: np.ndarray  # (O,) bool, chi2 within its 95 % quantile
    iterations: int  # accepted and rejected
    is_converged: bool
    covariance: "PoseCovariance | None" = None  # of the free key frames, if asked for and if something is fixed


class PoseCovariance:
    """The uncertainty of key-frame poses with the landmarks marginalized; (6, 6) blocks of left twists of T_cw, 0 where fixed."""

    def __init__(self, factor: Factor, place: np.ndarray, T_cw: np.ndarray) -> None:
        self._factor, self._place, self._T_cw = factor, place, T_cw
        self._n = int((place >= 0).sum())

    def joint(self, kfs: np.ndarray | list[int]) -> np.ndarray:
        """Return the joint covariance (6 m, 6 m) [m^2, rad^2] of m key frames."""
        columns = np.zeros((6 * self._n, 6 * len(kfs)))
        place = self._place[np.asarray(kfs, dtype=np.int64)]
        for m in np.flatnonzero(place >= 0):
            columns[6 * place[m] : 6 * place[m] + 6, 6 * m : 6 * m + 6] = np.eye(6)
        solved = self._factor.solve(columns)
        out = product(columns.T, solved)
        return 0.5 * (out + out.T)

    def relative(self, kf_i: int, kf_j: int) -> np.ndarray:
        """Return the covariance (6, 6) of the left twist of T_ij, x_i = T_ij x_j; its inverse is the information of a pose-graph edge."""
        T_ij = product(self._T_cw[kf_i], se3.inverse(self._T_cw[kf_j]))
        J = np.hstack([np.eye(6), -se3.adjoint(T_ij)])
        return product(J, self.joint([kf_i, kf_j]), J.T)


def adjust(
    T_cw: np.ndarray,
    x_w: np.ndarray,
    seen: Observations,
    camera: Camera,
    *,
    is_fixed: np.ndarray,
    edges: Edges = NO_EDGES,
    max_iterations: int = 10,
    robust: bool = True,
    outlier_iterations: int = 0,
    tolerance: float = 1e-5,
    chi2_px: float = CHI2_95_2DOF,
    chi2_depth: float = CHI2_95_3DOF,
    with_covariance: bool = False,
) -> BundleResult:
    """Adjust the free key frames and all landmarks to pixels and depths.

    T_cw : (K, 4, 4); x_w : (L, 3) [m]; is_fixed : (K,) bool, key frames that stay
    edges : relative poses of key frames that were measured besides

    Minimizes the sum over observations and edges of Huber's function of chi2, for observations = |xy - pi(x)|^2 / sigma_px^2 + (depth - z)^2 / sigma_z^2, which is
    chi2 up to its 95 % quantile and then grows like its root. With `outlier_iterations`, observations beyond the quantile after
    `max_iterations` are dropped and that many iterations follow without them. An iteration ends the adjustment when it lowers the cost
    by less than the share `tolerance`. A landmark seen once is adjusted with its depth; with one bearing alone it bears on nothing.
    Values that are not finite switch their observation off.
    """
    problem = Problem(T_cw, x_w, seen, camera, is_fixed, edges)
    quantiles = np.array([chi2_px, chi2_depth], dtype=np.float64)
    limits = quantiles if robust else np.array([np.inf, np.inf])
    T, x, cost, iterations, is_converged = _minimize(problem, problem.T, problem.x, limits, max_iterations, tolerance)
    in_use = problem.measured[:, 3].copy()
    if outlier_iterations:
        problem.measured[problem.chi2(T, x) > problem.threshold(quantiles), 3] = 0.0
        T, x, more, extra, is_converged = _minimize(problem, T, x, limits, outlier_iterations, tolerance)
        cost, iterations = cost + more, iterations + extra
    covariance = problem.covariance(T, x, limits) if with_covariance else None
    problem.measured[:, 3] = in_use
    chi2 = problem.chi2(T, x)
    is_inlier = chi2 <= problem.threshold(quantiles)
    x = np.where(problem.is_finite_landmark[:, None], x, np.nan)
    chi2, is_inlier = problem.in_given_order(chi2), problem.in_given_order(is_inlier)
    return BundleResult(T, x, cost, chi2, is_inlier, iterations, is_converged, covariance)


def _minimize(
    problem: "Problem", T: np.ndarray, x: np.ndarray, limits: np.ndarray, max_iterations: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray, list[float], int, bool]:
    """Run Levenberg-Marquardt; the damping follows H. Nielsen, Damping Parameter in Marquardt's Method, IMM-REP-1999-05."""
    T, x, T_new, x_new = T.copy(), x.copy(), np.empty_like(T), np.empty_like(x)
    cost = [problem.cost(T, x, limits)]
    damping, growth, is_linearized = DAMPING_START, 2.0, False
    for iteration in range(1, max_iterations + 1):
        if not is_linearized:
            problem.linearize(T, x, limits)
            is_linearized = True
        expected = problem.step(T, x, damping, T_new, x_new)
        if expected <= 0.1 * tolerance * cost[-1]:
            return T, x, cost, iteration, True
        new_cost = problem.cost(T_new, x_new, limits) if np.isfinite(expected) else np.inf
        if new_cost < cost[-1]:
            gain = (cost[-1] - new_cost) / expected
            is_converged = cost[-1] - new_cost <= tolerance * cost[-1]
            T, T_new, x, x_new = T_new, T, x_new, x
            cost.append(new_cost)
            if is_converged:
                return T, x, cost, iteration, True
            shift = 2.0 * gain - 1.0
            damping, growth, is_linearized = max(DAMPING_MIN, damping * max(0.1, 1.0 - shift * shift * shift)), 2.0, False
        else:
            damping, growth = damping * growth, 2.0 * growth
            if damping > DAMPING_MAX:
                return T, x, cost, iteration, True
    return T, x, cost, max_iterations, False


class Problem:
    """The observations as the kernels want them, and the work space of the normal equations."""

    def __init__(
        self, T_cw: np.ndarray, x_w: np.ndarray, seen: Observations, camera: Camera, is_fixed: np.ndarray, edges: Edges = NO_EDGES
    ) -> None:
        """Take what `adjust` takes; raises ValueError where the observations are not sorted by landmark."""
        obs_kf, obs_lm = np.asarray(seen.kf, dtype=np.int64), np.asarray(seen.lm, dtype=np.int64)
        if (np.diff(obs_lm) < 0).any():
            raise ValueError("observations must be sorted by landmark")
        self.T = np.array(T_cw, dtype=np.float64, order="C")
        self.x = np.array(x_w, dtype=np.float64, order="C").reshape(-1, 3)
        self.is_finite_landmark = np.all(np.isfinite(self.x), axis=1)
        self.x[~self.is_finite_landmark] = 0.0  # nothing observes it now, and NaN would spread
        measured = _measurements(seen, self.is_finite_landmark[obs_lm])
        in_use = measured[:, 3] > 0.0
        n_seen = np.bincount(obs_kf[in_use], minlength=len(self.T))
        n_seen += FEW_OBSERVATIONS * np.bincount(edges.kf.ravel(), minlength=len(self.T))  # an edge determines a pose by itself
        free = np.flatnonzero(~np.asarray(is_fixed, dtype=bool) & (n_seen > 0))
        self.place, self.system = order_and_blocks(free, obs_kf, obs_lm, len(self.T), edges.kf)
        self.edge_terms = EdgeTerms(edges, self.place, self.system.block_of)
        self.offset = np.searchsorted(obs_lm, np.arange(len(self.x) + 1)).astype(np.int64)
        self.order = _stable_order(obs_lm * (len(self.T) + 1) + self.place[obs_kf] + 1)
        self.measured = measured[self.order]
        self.obs_kf = obs_kf[self.order].astype(np.uint64)
        self.camera = np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64)
        n, n_landmarks = len(free), len(self.x)
        self.hold = np.zeros(n)
        self.hold[self.place[free]] = np.where(n_seen[free] < FEW_OBSERVATIONS, HOLD, 0.0)
        self.U, self.b_c, self.rhs = np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 6))
        self.V, self.b_l, self.V_inv = np.empty((n_landmarks, 3, 3)), np.empty((n_landmarks, 3)), np.empty((n_landmarks, 6))
        self.W, self.Y = np.empty((len(obs_kf), 3, 6)), np.empty((int(np.diff(self.offset).max(initial=0)), 6, 3))

    def in_given_order(self, values: np.ndarray) -> np.ndarray:
        """Undo the reordering of the observations."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    def threshold(self, quantiles: np.ndarray) -> np.ndarray:
        """Return the chi2 quantile (O,) that belongs to each observation's number of residuals."""
        return np.where(self.measured[:, 4] > 0.0, quantiles[1], quantiles[0])

    def _evaluate(self, T: np.ndarray, x: np.ndarray, limits: np.ndarray) -> tuple[float, np.ndarray]:
        chi2 = np.empty(len(self.obs_kf))
        return kernels.evaluate(T, x, self.obs_kf, self.offset, self.measured, self.camera, limits, chi2), chi2

    def cost(self, T: np.ndarray, x: np.ndarray, limits: np.ndarray) -> float:
        """Return the sum of Huber's costs; limits : (2,) chi2 from which it grows like the root, without and with depth."""
        return self._evaluate(T, x, limits)[0] + self.edge_terms.cost(T, np.isfinite(limits).all())

    def chi2(self, T: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return chi2 (O,), inf where switched off or behind the camera."""
        chi2 = self._evaluate(T, x, np.array([np.inf, np.inf]))[1]
        return np.where((self.measured[:, 3] == 0.0) | (chi2 >= kernels.CHI2_BEHIND), np.inf, chi2)

    def predict(self, T: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Project the landmarks into the key frames that see them, (O, 3) u, v [px], depth [m], in the problem's order."""
        lm = np.repeat(np.arange(len(x)), np.diff(self.offset))
        T_of = T[self.obs_kf.astype(np.int64)]
        x_c = np.einsum("oij,oj->oi", T_of[:, :3, :3], x[lm]) + T_of[:, :3, 3]
        z = np.maximum(x_c[:, 2], kernels.Z_MIN)
        fx, fy, cx, cy = self.camera
        return np.stack([fx * x_c[:, 0] / z + cx, fy * x_c[:, 1] / z + cy, z], axis=1)

    def linearize(self, T: np.ndarray, x: np.ndarray, limits: np.ndarray, *, measured: np.ndarray | None = None) -> None:
        """Fill the blocks of the normal equations U, b_c, V, b_l, W; `measured` (O, 5) stands in for what was measured."""
        for block in (self.U, self.b_c, self.V, self.b_l):
            block.fill(0.0)
        measured = self.measured if measured is None else measured
        observations = (self.obs_kf, self.offset, self.place, measured, self.camera)
        kernels.linearize(T, x, *observations, limits, self.U, self.b_c, self.V, self.b_l, self.W)
        self.edge_terms.linearize(T, np.isfinite(limits).all(), self.U, self.b_c)

    def eliminate(self, damping: float, hold: np.ndarray) -> None:
        """Fill the reduced camera system from them: `system.blocks`, rhs, V_inv."""
        self.system.blocks.fill(0.0)
        blocks = (self.U, self.b_c, self.V, self.b_l, self.W, self.obs_kf, self.offset, self.place)
        kernels.eliminate(*blocks, damping, hold, self.system.block_of, self.system.blocks, self.rhs, self.V_inv, self.Y)
        self.edge_terms.add_to(self.system.blocks)

    def step(self, T: np.ndarray, x: np.ndarray, damping: float, T_new: np.ndarray, x_new: np.ndarray) -> float:
        """Write poses and landmarks after one damped step; return the decrease of the cost to be expected, NaN where none was found."""
        self.eliminate(damping, self.hold)
        factor = self.system.factorize()
        if factor is None:
            return np.nan
        dx = factor.solve(self.rhs.ravel()).reshape(-1, 6)
        blocks = (self.U, self.b_c, self.V, self.b_l, self.W, self.V_inv, self.obs_kf, self.offset, self.place)
        return kernels.step(T, x, *blocks, damping, self.hold, dx, T_new, x_new)

    def covariance(self, T: np.ndarray, x: np.ndarray, limits: np.ndarray) -> PoseCovariance | None:
        """Factorize the undamped system at the result; None where the poses are not determined."""
        self.linearize(T, x, limits)
        # The least damping regularizes landmarks with one bearing, which bear on nothing, and is lost in the digits of all others.
        self.eliminate(DAMPING_MIN, np.zeros_like(self.hold))
        factor = self.system.factorize()
        return None if factor is None else PoseCovariance(factor, self.place, T)


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
    measured, columns = np.empty((len(xy), 5)), (xy[:, 0], xy[:, 1], depth, inv_px, inv_z)
    for k, (column, is_given) in enumerate(zip(columns, (is_valid, is_valid, has_depth, is_valid, has_depth), strict=True)):
        measured[:, k] = np.where(is_given, column, 0.0)
    return measured
