"""Numbers that all observations share: their gradients against slow twins, and their estimate against the whole normal equations."""

import naive
import numpy as np
from bundle_scene import Scene, drive

from slamcli.estimation import shared_parameters
from slamcli.estimation.bundle_problem import Problem
from slamcli.estimation.robust_loss import LEAST_SQUARES


def problem_of(scene: Scene) -> Problem:
    return scene.problem(loss=LEAST_SQUARES)


def columns_of(problem: Problem, rng: np.random.Generator, n: int = 2) -> np.ndarray:
    """How much a few numbers move each measurement, in the order of the problem."""
    return rng.normal(0.0, [[1.0], [1.0], [0.01]], (len(problem.measured), 3, n))


def gradient(problem: Problem, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minus the gradient had the observations measured this: of the reduced system, and of the landmarks."""
    problem.linearize(problem.start, measured=measured)
    problem.eliminate(shared_parameters.LEAST_DAMPING, problem.hold)
    return problem.rhs.copy().ravel(), problem.normal.b_l.copy()


def minus_gradient(problem: Problem, shift: np.ndarray | float) -> np.ndarray:
    """By all key frames in turn, then by the landmarks, had the observations measured so much more."""
    measured = problem.measured.copy()
    measured[:, :3] += shift
    problem.linearize(problem.start, measured=measured)
    by_poses = np.where(problem.place[:, None] >= 0, problem.normal.b_c[problem.place], 0.0)
    return np.concatenate([by_poses.ravel(), problem.normal.b_l.ravel()])


def test_gradients_are_what_shifted_measurements_change():
    scene, rng = drive(5, 60, share=0.6), np.random.default_rng(1)
    problem = problem_of(scene)
    used, columns = problem.measured.copy(), columns_of(problem, rng)
    used[::7, 3:] = 0.0  # outliers are switched off
    before = gradient(problem, used)
    reduced, lifted = problem.shared_gradients(used, columns)
    for g in range(columns.shape[2]):
        shifted = used.copy()
        shifted[:, :3] += columns[:, :, g]
        after = gradient(problem, shifted)
        for found, a, b in ((reduced[g], *(x[0] for x in (after, before))), (lifted[g], *(x[1] for x in (after, before)))):
            np.testing.assert_allclose(found, a - b, rtol=1e-6, atol=1e-8 * np.abs(a).max())


def test_the_estimate_solves_the_normal_equations_of_all_unknowns_together():
    scene, rng = drive(4, 40, share=0.7, noise=0.4, start=0.0), np.random.default_rng(2)
    problem = problem_of(scene)
    columns = columns_of(problem, rng)
    given = np.stack([problem.in_given_order(columns[:, i]) for i in range(3)], axis=1)
    chi2 = problem.chi2(problem.start)
    assert problem.is_inlier(chi2).all()  # none is left out as an outlier
    found = shared_parameters.estimate(problem, given, prior=np.zeros(2), prior_sigma=np.full(2, 1e3))

    H, b = naive.bundle_normal_equations(*scene.given, LEAST_SQUARES)
    C = np.stack([minus_gradient(problem, columns[:, :, g]) - minus_gradient(problem, 0.0) for g in range(2)], axis=1)
    weight = problem.measured[:, [3, 3, 4]]
    J = (columns * weight[:, :, None]).reshape(-1, 2)
    r = ((problem.predict(problem.start) - problem.measured[:, :3]) * weight).ravel()
    is_free = np.arange(len(H)) >= 6  # the first key frame is fixed
    C, b, H_inv = (
        C[is_free],
        b[is_free],
        np.linalg.pinv(H[np.ix_(is_free, is_free)], rcond=1e-12, hermitian=True),
    )  # one bearing is no place
    A = J.T @ J - C.T @ H_inv @ C + np.eye(2) * 1e-6
    np.testing.assert_allclose(found.value, np.linalg.solve(A, J.T @ r + C.T @ H_inv @ b), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diag(np.linalg.inv(A))), rtol=1e-4)
