"""A camera that drives past landmarks: the problem that tests of bundle adjustment share."""

from dataclasses import dataclass, replace

import numpy as np

from slamcli.estimation.bundle_adjustment import BundleResult
from slamcli.estimation.bundle_problem import Observations, Problem, Variables
from slamcli.estimation.relative_pose_factors import NO_EDGES, Edges
from slamcli.estimation.robust_loss import HUBER, LEAST_SQUARES, Huber
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

CAMERA = Camera(width=640, height=480, fx=520.0, fy=515.0, cx=319.5, cy=240.5)


@dataclass(frozen=True)
class Scene:
    """A camera that drives past landmarks: truth, and a start with errors."""

    T_true: np.ndarray
    x_true: np.ndarray
    T_cw: np.ndarray
    x_w: np.ndarray
    obs_kf: np.ndarray
    obs_lm: np.ndarray
    xy: np.ndarray
    depth: np.ndarray
    sigma_px: np.ndarray
    sigma_z: np.ndarray

    @property
    def given(self) -> tuple:
        """What slow twins and g2o take."""
        seen = Observations(self.obs_kf, self.obs_lm, self.xy, self.depth, self.sigma_px, self.sigma_z)
        return self.T_cw, self.x_w, seen, CAMERA

    def problem(self, *, is_fixed: np.ndarray | None = None, edges: Edges = NO_EDGES, loss: Huber = HUBER) -> Problem:
        """What is adjusted, with the first key frame fixed if nothing else is said."""
        T_cw, x_w, seen, camera = self.given
        return Problem(Variables(T_cw, x_w), seen, camera, is_fixed=self.first if is_fixed is None else is_fixed, edges=edges, loss=loss)

    @property
    def first(self) -> np.ndarray:
        return np.arange(len(self.T_cw)) == 0

    def keep(self, rows: np.ndarray) -> "Scene":
        columns = ("obs_kf", "obs_lm", "xy", "depth", "sigma_px", "sigma_z")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def drive(
    n_kf: int = 8, n_lm: int = 200, *, seed: int = 0, noise: float = 1.0, start: float = 1.0, step: float = 0.15, share: float = 1.0
) -> Scene:
    rng = np.random.default_rng(seed)
    x_true = np.column_stack([rng.uniform(-2, 2 + step * n_kf, n_lm), rng.uniform(-1.2, 1.2, n_lm), rng.uniform(1.5, 4.5, n_lm)])
    x_true = x_true[np.argsort(x_true[:, 0], kind="stable")]  # numbered as mapping finds them
    T_true = se3.exp(np.column_stack([-step * np.arange(n_kf), np.zeros((n_kf, 2)), 0.05 * rng.normal(size=(n_kf, 3))]))
    x_c = np.einsum("kij,lj->kli", T_true[:, :3, :3], x_true) + T_true[:, None, :3, 3]
    uv = CAMERA.project(x_c)
    is_seen = (x_c[..., 2] > 0.3) & (uv > 0).all(axis=2) & (uv < [640, 480]).all(axis=2) & (rng.random(uv.shape[:2]) < share)
    obs_lm, obs_kf = np.nonzero(is_seen.T)
    z = x_c[obs_kf, obs_lm, 2]
    sigma_px, sigma_z = rng.choice([1.0, 1.2, 1.44], len(z)), 0.0012 + 0.0019 * (z - 0.4) ** 2
    depth = z + noise * sigma_z * rng.normal(size=len(z))
    depth[z > 3.8] = np.nan
    error = np.concatenate([np.zeros((1, 6)), start * rng.normal(size=(n_kf - 1, 6)) * [0.02, 0.02, 0.02, 0.01, 0.01, 0.01]])
    return Scene(
        T_true=T_true, x_true=x_true, T_cw=se3.exp(error) @ T_true, x_w=x_true + 0.03 * start * rng.normal(size=x_true.shape),
        obs_kf=obs_kf.astype(np.int32), obs_lm=obs_lm.astype(np.int32),
        xy=uv[obs_kf, obs_lm] + noise * sigma_px[:, None] * rng.normal(size=(len(z), 2)), depth=depth, sigma_px=sigma_px, sigma_z=sigma_z,
    )  # fmt: skip


def pose_error(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    return se3.log(T @ se3.inverse(T_true))


def covariance(scene: Scene, found: BundleResult, kfs: list[int], edges: Edges = NO_EDGES) -> np.ndarray:
    """Joint covariance of the left twists of key frames after an adjustment that held the first: the inverse of the reduced camera system."""
    problem = replace(scene, T_cw=found.T_cw, x_w=found.x_w).problem(edges=edges, loss=LEAST_SQUARES)
    problem.linearize(problem.start)
    problem.eliminate(1e-9, np.zeros(len(problem.hold)))
    inverse = problem.system.factorize().solve(np.eye(6 * len(problem.hold)))
    rows = np.concatenate([6 * problem.place[kf] + np.arange(6) for kf in kfs])
    return inverse[np.ix_(rows, rows)]
