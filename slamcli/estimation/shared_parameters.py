"""Numbers that all observations of a bundle problem share, such as a focal length or a delay, estimated at the adjusted map.

A shared number g moves each measurement by J g. At the optimum of a bundle adjustment, with r the residuals, H and b the normal equations
of key frames and landmarks and C = J_map^T w J, eliminating the map leaves

    (J^T w J - C^T H^-1 C) g = J^T w r - C^T H^-1 J_map^T w r

which is small, and whose inverse is the covariance of g.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.estimation.bundle_adjustment import DAMPING_MIN, Problem
from slamcli.estimation.camera_pose import CHI2_95_2DOF, CHI2_95_3DOF
from slamcli.geometry.algebra import inverse, product, solve


@dataclass(frozen=True)
class Shared:
    """The numbers found and how sure they are."""

    value: np.ndarray  # (G,)
    sigma: np.ndarray  # (G,) standard deviations


def estimate(problem: Problem, columns: np.ndarray, *, prior: np.ndarray, prior_sigma: np.ndarray) -> Shared | None:
    """Estimate the shared numbers at the poses and landmarks that the problem was built with, which are to be its optimum.

    columns : (O, 3, G) by how much u, v [px] and depth [m] of each observation grow per unit of each number
    prior, prior_sigma : (G,) what is believed before looking. None where the map is not determined.
    """
    T, x, columns = problem.T, problem.x, columns[problem.order]
    # Outliers stay out; among the inliers Huber's weights are close to 1 and are left out.
    is_used = problem.chi2(T, x) <= problem.threshold(np.array([CHI2_95_2DOF, CHI2_95_3DOF]))
    used = problem.measured.copy()
    used[:, 3:] *= is_used[:, None]
    sqrt_w = used[:, [3, 3, 4]]
    r = (problem.predict(T, x) - used[:, :3]) * sqrt_w
    rhs_0, b_0 = _gradient(problem, used)
    reduced, lifted = np.empty((columns.shape[2], len(rhs_0))), np.empty((columns.shape[2], *b_0.shape))
    for g in range(columns.shape[2]):
        shifted = used.copy()
        shifted[:, :3] += columns[:, :, g]
        rhs, b = _gradient(problem, shifted)
        reduced[g], lifted[g] = rhs - rhs_0, b - b_0
    factor = problem.system.factorize()
    if factor is None:
        return None
    solved = factor.solve(np.ascontiguousarray(np.concatenate([reduced, rhs_0[None]]).T)).T
    J = (columns * sqrt_w[:, :, None]).reshape(-1, columns.shape[2])
    through_landmarks = np.array([[_landmark_product(a, problem.V_inv, b) for b in (*lifted, b_0)] for a in lifted])
    through_map = product(reduced, solved.T) + through_landmarks
    weight = 1.0 / (prior_sigma * prior_sigma)
    A = product(J.T, J) - through_map[:, :-1] + np.diag(weight)
    # b is minus the gradient: J_map^T w r = -b_0
    value = solve(A, product(J.T, r.ravel()) + through_map[:, -1] + prior * weight)
    return Shared(value=value, sigma=np.sqrt(np.diag(inverse(A))))


def _gradient(problem: Problem, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute minus the gradient of the map had the observations measured this: of the reduced system, and of the landmarks."""
    problem.linearize(problem.T, problem.x, np.array([np.inf, np.inf]), measured=measured)
    problem.eliminate(DAMPING_MIN, problem.hold)
    return problem.rhs.copy().ravel(), problem.b_l.copy()


def _landmark_product(a: np.ndarray, V_inv: np.ndarray, b: np.ndarray) -> float:
    """Sum a^T V^-1 b over the landmarks; V_inv (L, 6) upper triangles."""
    rows = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    return float(sum((a[:, i] * V_inv[:, rows[i][j]] * b[:, j]).sum() for i in range(3) for j in range(3)))
