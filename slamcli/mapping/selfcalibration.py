"""What the recording itself says about its camera: numbers that all observations share, found together with the map.

A shared number g moves each measurement by J g. At the optimum of a bundle adjustment, with r the residuals, H and b the normal equations
of key frames and landmarks and C = J_map^T w J, eliminating the map leaves

    (J^T w J - C^T H^-1 C) g = J^T w r - C^T H^-1 J_map^T w r

which is small, and whose inverse is the covariance of g.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.config import SensorConfig
from slamcli.geometry.camera import Camera
from slamcli.mapping import adjustment, bundle, bundle_kernels, timing
from slamcli.mapping.mapbuilder import MapBuilder
from slamcli.schema import Features, Timing


@dataclass(frozen=True)
class Shared:
    """The numbers found and how sure they are."""

    value: np.ndarray  # (G,)
    sigma: np.ndarray  # (G,) standard deviations


def estimate_timing(
    builder: MapBuilder, features: Features, now: Timing, camera: Camera, sensor: SensorConfig, *, prior_sigma: np.ndarray
) -> tuple[Timing, np.ndarray] | None:
    """Find the readout time and the depth delay at an adjusted map whose features were rectified by `now`.

    features : as measured; prior_sigma : (2,) [s] of readout and depth delay around 0
    Returns the better timing, with the same motion, and the standard deviations (2,) [s]; None where the map is not determined.
    """
    part = adjustment.gather(builder, np.arange(len(builder.kf), dtype=np.int32), sensor)
    if len(part.row) == 0:
        return None
    T_kw, x_w = builder.T_kw(part.kfs), builder.lm.xyz[part.ids]
    problem = bundle.Problem(T_kw, x_w, *part.arguments, camera, part.is_fixed, part.edges)
    px_per_s, depth_per_s, share = timing.flow(features, now.twist, camera, part.row)
    columns = np.zeros((len(part.row), 3, 2))
    columns[:, :2, 0] = -px_per_s * share[:, None]
    columns[:, 2, 1] = -depth_per_s
    found = estimate(problem, problem.T, problem.x, columns, prior=-np.array([now.readout, now.depth_delay]), prior_sigma=prior_sigma)
    if found is None:
        return None
    better = Timing(readout=np.array(now.readout + found.value[0]), depth_delay=np.array(now.depth_delay + found.value[1]), twist=now.twist)
    return better, found.sigma


def estimate(
    problem: bundle.Problem, T_cw: np.ndarray, x_w: np.ndarray, columns: np.ndarray, *, prior: np.ndarray, prior_sigma: np.ndarray
) -> Shared | None:
    """Find the shared numbers at an adjusted map.

    columns : (O, 3, G) by how much u, v [px] and depth [m] of each observation grow per unit of each number
    prior, prior_sigma : (G,) what is believed before looking. None where the map is not determined.
    """
    # Outliers stay out; among the inliers Huber's weights are close to 1 and are left out.
    no_limits = np.array([np.inf, np.inf])
    chi2 = problem.chi2(T_cw, x_w)
    is_used = chi2 <= problem.threshold(np.array([bundle.CHI2_95_2DOF, bundle.CHI2_95_3DOF]))
    measured = problem.measured.copy()
    columns = columns[problem.order]
    sqrt_w = measured[:, [3, 3, 4]] * is_used[:, None]
    problem.measured[:, 3:] *= is_used[:, None]
    r = residuals(problem, T_cw, x_w) * sqrt_w
    systems = []
    for g in range(-1, columns.shape[2]):  # -1: the map's own residuals; then each shared number in turn
        problem.measured[:, :3] = measured[:, :3]
        if g >= 0:
            problem.measured[:, :3] += columns[:, :, g]
        problem.linearize(T_cw, x_w, no_limits)
        problem.eliminate(bundle.DAMPING_MIN, problem.hold)
        systems.append((problem.rhs.copy().ravel(), problem.b_l.copy()))
    V_inv = problem.V_inv.copy()
    factor = problem.system.factorise()
    problem.measured[:] = measured
    if factor is None:
        return None
    rhs_0, b_0 = systems[0]
    reduced = np.array([rhs - rhs_0 for rhs, _ in systems[1:]])
    lifted = np.array([b - b_0 for _, b in systems[1:]])
    solved = factor.solve(np.ascontiguousarray(np.concatenate([reduced, rhs_0[None]]).T)).T
    J = (columns * sqrt_w[:, :, None]).reshape(-1, columns.shape[2])
    through_landmarks = np.array([[_landmark_product(a, V_inv, b) for b in (*lifted, b_0)] for a in lifted])
    through_map = reduced @ solved.T + through_landmarks
    A = J.T @ J - through_map[:, :-1] + np.diag(prior_sigma**-2.0)
    # b is minus the gradient: J_map^T w r = -b_0
    value = np.linalg.solve(A, J.T @ r.ravel() + through_map[:, -1] + prior * prior_sigma**-2.0)
    return Shared(value=value, sigma=np.sqrt(np.diag(np.linalg.inv(A))))


def residuals(problem: bundle.Problem, T_cw: np.ndarray, x_w: np.ndarray) -> np.ndarray:
    """Give prediction minus measurement (O, 3) [px, px, m] in the problem's order."""
    lm = np.repeat(np.arange(len(x_w)), np.diff(problem.offset))
    T = T_cw[problem.obs_kf.astype(np.int64)]
    x_c = np.einsum("oij,oj->oi", T[:, :3, :3], x_w[lm]) + T[:, :3, 3]
    z = np.maximum(x_c[:, 2], bundle_kernels.Z_MIN)
    fx, fy, cx, cy = problem.camera
    predicted = np.stack([fx * x_c[:, 0] / z + cx, fy * x_c[:, 1] / z + cy, z], axis=1)
    return predicted - problem.measured[:, :3]


def _landmark_product(a: np.ndarray, V_inv: np.ndarray, b: np.ndarray) -> float:
    """Sum a^T V^-1 b over the landmarks; V_inv (L, 6) upper triangles."""
    rows = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    return float(sum((a[:, i] * V_inv[:, rows[i][j]] * b[:, j]).sum() for i in range(3) for j in range(3)))
