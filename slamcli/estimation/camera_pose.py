"""Camera pose from known landmarks: P3P in RANSAC for a start, then robust refinement of the motion alone."""

from dataclasses import dataclass

import numpy as np

from slamcli.estimation import pose_kernels as kernels
from slamcli.estimation.measurements import Measurements
from slamcli.estimation.minimal_solvers import p3p, rigid3
from slamcli.estimation.pose_kernels import Agreement, Hypotheses, Seen
from slamcli.estimation.robust_loss import HUBER, Huber
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera


@dataclass(frozen=True)
class PoseEstimate:
    """A pose and the evidence for it."""

    T_cw: np.ndarray  # (4, 4)
    is_inlier: np.ndarray  # (N,) bool
    n_inliers: int
    information: np.ndarray  # (6, 6) inverse covariance of the left twist (rho, phi) [1/m^2, 1/rad^2]; 0 = not estimated
    rms: float  # px, reprojection error of the inliers
    cost: float = np.nan  # robust chi2 of the inliers
    iterations: int = 0  # of RANSAC or of Levenberg-Marquardt


@dataclass(frozen=True)
class RigidMotion:
    """A rigid motion between two cameras and the evidence for it."""

    T_ba: np.ndarray  # (4, 4) camera a to camera b
    is_inlier: np.ndarray  # (N,) bool
    rms: float  # px, in camera b, of the inliers
    iterations: int  # of RANSAC


@dataclass(frozen=True)
class Ransac:
    """How many samples are drawn, and which pairs agree with what one of them says."""

    rounds: int = 100  # samples at most
    threshold_px: float = 4.0  # reprojection error of an inlier
    confidence: float = 0.9999  # rounds end early once a sample free of outliers has been drawn with this probability

    def agreement(self, camera: Camera, size: int) -> Agreement:
        """Return when a point agrees, as the kernel takes it, with samples of `size` points."""
        return Agreement(camera.fx, camera.fy, self.threshold_px * self.threshold_px, size, self.confidence)


@dataclass(frozen=True)
class SeenPoints:
    """Points as one camera sees them."""

    x_c: np.ndarray  # (N, 3) m, in the camera's frame
    xy: np.ndarray  # (N, 2) px, undistorted


def ransac_p3p(
    x_w: np.ndarray, xy: np.ndarray, camera: Camera, *, rng: np.random.Generator, ransac: Ransac = Ransac()
) -> PoseEstimate | None:
    """Find the camera pose that most landmarks agree with.

    x_w : (N, 3) [m], xy : (N, 2) [px, undistorted]
    Each round solves P3P on three pairs and lets a fourth choose among its solutions.
    None where there are fewer than four pairs or no sample had a solution.

    [Z] 1.2; M. Fischler, R. Bolles, CACM 1981, doi:10.1145/358669.358692
    """
    n = len(x_w)
    if n < 4:
        return None
    x_w, ray = _points(x_w), _rays(xy, camera)
    sample = draw_samples(rng, n, ransac.rounds, 4)
    solutions = p3p(x_w[sample[:, :3]], np.concatenate([ray, np.ones((n, 1))], axis=1)[sample[:, :3]])
    T = _best_of_four(solutions, x_w[sample[:, 3]], ray[sample[:, 3]])
    is_inlier = np.zeros(n, dtype=np.bool_)
    tested = Hypotheses(T, x_w, ray)
    best, done = kernels.rank(tested, tested, False, ransac.agreement(camera, 4), is_inlier)
    return None if best < 0 else _ransac_estimate(T[best], is_inlier, done, _rms(T[best], x_w, ray, camera, is_inlier))


def ransac_rigid(
    a: SeenPoints, b: SeenPoints, camera: Camera, *, rng: np.random.Generator, ransac: Ransac = Ransac()
) -> RigidMotion | None:
    """Find the rigid motion between two cameras that most point pairs agree with.

    a, b : the same N landmarks as camera a and as camera b sees them
    A pair is an inlier when its point in a falls within the threshold of its pixel in b, and its point in b within that of its pixel in a.
    None where there are fewer than three pairs or no sample spanned a plane.
    """
    n = len(a.x_c)
    if n < 3:
        return None
    x_a, x_b, ray_a, ray_b = _points(a.x_c), _points(b.x_c), _rays(a.xy, camera), _rays(b.xy, camera)
    sample = draw_samples(rng, n, ransac.rounds, 3)
    T_ba = rigid3(x_a[sample], x_b[sample])
    R_ab = np.swapaxes(T_ba[:, :, :3], 1, 2)
    T_ab = np.ascontiguousarray(np.concatenate([R_ab, product(-R_ab, T_ba[:, :, 3:])], axis=2))
    is_inlier = np.zeros(n, dtype=np.bool_)
    there, back = Hypotheses(T_ba, x_a, ray_b), Hypotheses(T_ab, x_b, ray_a)
    best, done = kernels.rank(there, back, True, ransac.agreement(camera, 3), is_inlier)
    if best < 0:
        return None
    return RigidMotion(_matrix(T_ba[best]), is_inlier, _rms(T_ba[best], x_a, ray_b, camera, is_inlier), done)


def refine_pose(T_cw: np.ndarray, x_w: np.ndarray, measured: Measurements, camera: Camera, *, loss: Huber = HUBER) -> PoseEstimate:
    """Refine a pose by Levenberg-Marquardt on the reprojection and depth residuals of fixed landmarks, (6)-(8).

    T_cw : (4, 4) start; x_w : (N, 3) [m]; measured : N rows; where depth or its sigma is NaN, the pixel alone counts
    After each round observations are sorted anew into inliers and outliers by chi2, so an early mistake can be mended; it ends when
    nothing changes. Observations with a value that is not finite are outliers. The loss acts on an observation as a whole; what it begins
    to doubt is an outlier.
    """
    start, is_inlier = se3.orthonormalize(T_cw), np.empty(len(x_w), dtype=np.bool_)
    with np.errstate(divide="ignore"):  # a standard deviation of 0 gives a weight that is not finite: an outlier
        weights = (1.0 / _cast(measured.sigma_px), 1.0 / _cast(measured.sigma_z))
    seen = Seen(_points(x_w), _cast(measured.xy), _cast(measured.depth), *weights)
    T, H, cost, total, rms = kernels.refine(start, seen, _intrinsics(camera), loss, is_inlier)
    return PoseEstimate(
        T_cw=T,
        is_inlier=is_inlier,
        n_inliers=int(np.count_nonzero(is_inlier)),
        information=H,
        rms=rms,
        cost=cost,
        iterations=total,
    )


def draw_samples(rng: np.random.Generator, n: int, rounds: int, size: int) -> np.ndarray:
    """Draw `rounds` samples of `size` different numbers below n, (rounds, size) int64."""
    sample = np.empty((rounds, size), dtype=np.int64)
    for k in range(size):
        # A number of the n - k not yet taken, moved up past each taken one at or below it, the smallest first.
        value = rng.integers(0, n - k, size=rounds)
        for taken in np.sort(sample[:, :k], axis=1).T:
            value += value >= taken
        sample[:, k] = value
    return sample


def _best_of_four(solutions: np.ndarray, x: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Choose of the solutions (M, 4, 3, 4) the one that sees a fourth point x (M, 3) nearest to its ray (M, 2); NaN where there is none."""
    x_c = np.einsum("msij,mj->msi", solutions[..., :3], x) + solutions[..., 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        error = ((x_c[..., :2] / x_c[..., 2:] - ray[:, None]) ** 2).sum(axis=2)
        error = np.where(x_c[..., 2] > 0.0, error, np.inf)
    chosen = np.argmin(np.where(np.isnan(error), np.inf, error), axis=1)
    return np.ascontiguousarray(solutions[np.arange(len(x)), chosen])


def _matrix(T: np.ndarray) -> np.ndarray:
    """Return a pose (3, 4) as an orthonormal (4, 4) matrix."""
    return se3.orthonormalize(np.vstack([T, [0.0, 0.0, 0.0, 1.0]]))


def _ransac_estimate(T: np.ndarray, is_inlier: np.ndarray, rounds: int, rms: float) -> PoseEstimate:
    return PoseEstimate(
        T_cw=_matrix(T),
        is_inlier=is_inlier,
        n_inliers=int(is_inlier.sum()),
        information=np.zeros((6, 6)),
        rms=rms,
        iterations=rounds,
    )


def _rms(T: np.ndarray, x: np.ndarray, ray: np.ndarray, camera: Camera, is_inlier: np.ndarray) -> float:
    """Return the root mean square reprojection error [px] of the inliers, NaN without any."""
    if not is_inlier.any():
        return float("nan")
    x_c = se3.transform(T, x)
    with np.errstate(divide="ignore", invalid="ignore"):  # of the others
        u, v = camera.fx * (x_c[:, 0] / x_c[:, 2] - ray[:, 0]), camera.fy * (x_c[:, 1] / x_c[:, 2] - ray[:, 1])
    return float(np.sqrt((u * u + v * v)[is_inlier].mean()))


def _cast(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)


def _points(x: np.ndarray) -> np.ndarray:
    return _cast(x).reshape(-1, 3)


def _rays(xy: np.ndarray, camera: Camera) -> np.ndarray:
    return (_cast(xy).reshape(-1, 2) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]


def _intrinsics(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64)
