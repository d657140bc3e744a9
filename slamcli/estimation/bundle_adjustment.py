"""Bundle adjustment: key-frame poses and landmarks together, by Levenberg-Marquardt with the landmarks eliminated.

B. Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, doi:10.1007/3-540-44480-7_21; [Z] 1.2, [L] 1.2.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.estimation.bundle_problem import Problem, Variables

DAMPING_START, DAMPING_MIN, DAMPING_MAX = 1e-5, 1e-9, 1e8  # factor on the diagonal of the normal equations; beyond, no step lowers the cost
LARGEST_RELIEF = 0.1  # factor on the damping after a step that the linearized problem foretold well
FORETOLD = 0.1  # of the tolerance: a step of which less is expected is not worth its evaluation


@dataclass(frozen=True)
class BundleResult:
    """The adjusted poses and landmarks and the evidence for them."""

    T_cw: np.ndarray  # (K, 4, 4)
    x_w: np.ndarray  # (L, 3) m
    cost: list[float]  # sum of the loss, at the start and after every accepted iteration
    chi2: np.ndarray  # (O,) at the result, also of outliers; inf where the landmark is behind the camera or a value is not finite
    is_inlier: np.ndarray  # (O,) bool, chi2 within its 95 % quantile
    iterations: int  # accepted and rejected
    is_converged: bool


def adjust(problem: Problem, *, max_iterations: int = 10, tolerance: float = 1e-5) -> BundleResult:
    """Adjust the free key frames and all landmarks of a problem to pixels and depths, from its start.

    tolerance : share of the cost; an iteration that lowers it by less ends the adjustment

    Minimizes the sum of the loss over observations and edges; chi2 of an observation is
    |xy - pi(x)|^2 / sigma_px^2 + (depth - z)^2 / sigma_z^2.
    A landmark seen once is adjusted with its depth; with one bearing alone it bears on nothing. Values that are not finite switch
    their observation off.
    """
    found = minimize(problem, max_iterations=max_iterations, tolerance=tolerance)
    chi2 = problem.chi2(found.at)
    return BundleResult(
        T_cw=found.at.T_cw,
        x_w=np.where(problem.is_finite_landmark[:, None], found.at.x_w, np.nan),
        cost=found.cost,
        chi2=problem.in_given_order(chi2),
        is_inlier=problem.in_given_order(problem.is_inlier(chi2)),
        iterations=found.iterations,
        is_converged=found.is_converged,
    )


@dataclass(frozen=True)
class Minimum:
    """The result of Levenberg-Marquardt."""

    at: Variables
    cost: list[float]  # at the start and after every accepted iteration
    iterations: int  # accepted and rejected
    is_converged: bool


def minimize(problem: Problem, *, max_iterations: int, tolerance: float) -> Minimum:
    """Run Levenberg-Marquardt from the problem's start: linearize, solve for a damped step, accept it if the cost falls."""
    at, cost, damping = problem.start, [problem.cost(problem.start)], Damping()
    is_linearized = False
    for iteration in range(1, max_iterations + 1):
        if not is_linearized:
            problem.linearize(at)
        step = problem.step(at, damping.value)
        if step.decrease <= FORETOLD * tolerance * cost[-1]:
            return Minimum(at, cost, iteration, is_converged=True)
        cost_there = problem.cost(step.to) if np.isfinite(step.decrease) else np.inf
        is_accepted = cost_there < cost[-1]
        if is_accepted:
            decrease = cost[-1] - cost_there
            is_converged = decrease <= tolerance * cost[-1]
            at = step.to
            cost.append(cost_there)
            damping.relax(gain=decrease / step.decrease)
        else:
            damping.tighten()
            is_converged = damping.is_exhausted
        if is_converged:
            return Minimum(at, cost, iteration, is_converged=True)
        is_linearized = not is_accepted
    return Minimum(at, cost, max_iterations, is_converged=False)


class Damping:
    """How far a step is drawn from Gauss-Newton's towards the gradient's.

    H. Nielsen, Damping Parameter in Marquardt's Method, IMM-REP-1999-05.
    """

    def __init__(self) -> None:
        self.value, self._growth = DAMPING_START, 2.0

    def relax(self, gain: float) -> None:
        """Lower the damping after an accepted step; gain : the decrease of the cost over that foretold, 1 = the problem is as linear as it seems."""
        shift = 2.0 * gain - 1.0
        self.value, self._growth = max(DAMPING_MIN, self.value * max(LARGEST_RELIEF, 1.0 - shift * shift * shift)), 2.0

    def tighten(self) -> None:
        """Raise the damping after a rejected step, faster with each in a row."""
        self.value, self._growth = self.value * self._growth, 2.0 * self._growth

    @property
    def is_exhausted(self) -> bool:
        """Say whether steps have become too short to lower any cost."""
        return self.value > DAMPING_MAX
