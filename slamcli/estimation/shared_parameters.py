"""Numbers that all observations of a bundle problem share, such as a focal length or a delay, estimated at the adjusted map.

A shared number g moves each measurement by J g. At the optimum of a bundle adjustment, with r the residuals, H and b the normal equations
of key frames and landmarks and C = J_map^T w J, eliminating the map leaves

    (J^T w J - C^T H^-1 C) g = J^T w r - C^T H^-1 J_map^T w r

which is small, and whose inverse is the covariance of g.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.estimation.bundle_problem import INV_SIGMA_PX, INV_SIGMA_Z, PREDICTED, Problem
from slamcli.geometry.algebra import inverse, product, solve

# Factor on the diagonal: it regularizes landmarks with one bearing, which bear on nothing, and is lost in the digits of all others.
LEAST_DAMPING = 1e-9


@dataclass(frozen=True)
class Shared:
    """The numbers found and how sure they are."""

    value: np.ndarray  # (G,)
    sigma: np.ndarray  # (G,) standard deviations


@dataclass(frozen=True)
class SharedEvidence:
    """What observations alone say of shared numbers g, the map eliminated: information @ g = pull."""

    information: np.ndarray  # (G, G)
    pull: np.ndarray  # (G,)


def estimate(problem: Problem, columns: np.ndarray, *, prior: np.ndarray, prior_sigma: np.ndarray) -> Shared | None:
    """Estimate the shared numbers at the problem's start, which is to be its optimum; its loss is to be that of least squares.

    columns : (O, 3, G) by how much u, v [px] and depth [m] of each observation grow per unit of each number
    prior, prior_sigma : (G,) what is believed before looking. None where the map is not determined.
    """
    seen = evidence(problem, columns)
    if seen is None:
        return None
    weight = 1.0 / (prior_sigma * prior_sigma)
    A = seen.information + np.diag(weight)
    return Shared(value=solve(A, seen.pull + prior * weight), sigma=np.sqrt(np.diag(inverse(A))))


def evidence(problem: Problem, columns: np.ndarray) -> SharedEvidence | None:
    """Gather what the observations of a problem at its optimum say of shared numbers; arguments as for `estimate`."""
    columns = columns[problem.order]
    # Outliers stay out; among the inliers Huber's weights are close to 1 and are left out.
    is_used = problem.is_inlier(problem.chi2(problem.start))
    used = problem.measured.copy()
    used[:, [INV_SIGMA_PX, INV_SIGMA_Z]] *= is_used[:, None]
    sqrt_w = used[:, [INV_SIGMA_PX, INV_SIGMA_PX, INV_SIGMA_Z]]
    r = (problem.predict(problem.start) - used[:, PREDICTED]) * sqrt_w
    problem.linearize(problem.start, measured=used)
    problem.eliminate(LEAST_DAMPING, problem.hold)
    reduced, lifted = problem.shared_gradients(used, columns)
    rhs_0, b_0 = problem.rhs.ravel(), problem.normal.b_l
    factor = problem.system.factorize()
    if factor is None:
        return None
    solved = factor.solve(np.ascontiguousarray(np.concatenate([reduced, rhs_0[None]]).T)).T
    J = (columns * sqrt_w[:, :, None]).reshape(-1, columns.shape[2])
    through_landmarks = np.array([[_landmark_product(a, problem.V_inv, b) for b in (*lifted, b_0)] for a in lifted])
    through_map = product(reduced, solved.T) + through_landmarks
    # b is minus the gradient: J_map^T w r = -b_0
    return SharedEvidence(product(J.T, J) - through_map[:, :-1], product(J.T, r.ravel()) + through_map[:, -1])


def _landmark_product(a: np.ndarray, V_inv: np.ndarray, b: np.ndarray) -> float:
    """Sum a^T V^-1 b over the landmarks; V_inv (L, 6) upper triangles."""
    rows = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
    return float(sum((a[:, i] * V_inv[:, rows[i][j]] * b[:, j]).sum() for i in range(3) for j in range(3)))
