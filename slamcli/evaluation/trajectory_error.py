"""How far a trajectory is from the truth: absolute and relative pose error, computed by evo.

The protocol is the TUM benchmark's: SE(3) alignment without scale, association within 0.02 s, one-to-one and closest first, every colour
frame that has a pose. evo's own command line pairs nearest neighbours, within 0.01 s by default: told `--t_max_diff 0.02` it gives the
same figures, except where it would compare two poses with one true pose. What has no pose is not in the errors, so coverage always
stands beside them. Scale-fitted figures are given as well, never instead.

[Z] (15), (16); J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012, doi:10.1109/IROS.2012.6385773
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slamcli.datasets.association import MAX_DIFFERENCE, associate
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.schema import Trajectory

RPE_SECONDS = 1.0  # [s] interval over which drift is measured
RPE_TOLERANCE = 0.1  # share of that interval by which a pair may miss it, as in evo


@dataclass(frozen=True)
class Ape:
    """The absolute pose error of one trajectory. `N` poses have a true partner."""

    name: str
    stage: str  # "" for a trajectory that is not ours
    n_frames: int  # colour frames of the recording
    n_poses: int  # frames with a pose
    stamp: np.ndarray = field(repr=False)  # (N,) [s]
    error: np.ndarray = field(repr=False)  # (N,) [m], norm of trans(E_i)
    x_truth: np.ndarray = field(repr=False)  # (N, 3) [m], ground-truth frame
    x_aligned: np.ndarray = field(repr=False)  # (N, 3) [m], the estimate moved there
    T_gw: np.ndarray = field(repr=False)  # (4, 4) the alignment: estimate's world to ground truth
    scale: float  # that fits best; 1 is right
    rmse_scaled: float  # [m] after an alignment with that scale

    @property
    def rmse(self) -> float:
        """Return the root of the mean squared error [m]."""
        return rmse(self.error)

    @property
    def coverage(self) -> float:
        """Return the share of the recording's colour frames that have a pose."""
        return self.n_poses / self.n_frames if self.n_frames else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "name": self.name,
            "stage": self.stage,
            **statistics(self.error),
            "n_poses": self.n_poses,
            "n_frames": self.n_frames,
            "n_matched": len(self.stamp),
            "lost": self.n_frames - self.n_poses,
            "coverage": self.coverage,
            "scale": self.scale,
            "rmse_scaled": self.rmse_scaled,
            "alignment": "SE(3)",
            "max_difference": MAX_DIFFERENCE,
        }


@dataclass(frozen=True)
class Rpe:
    """The relative pose error over a fixed interval. `N` pairs of poses."""

    name: str
    stage: str
    n_frames: int
    n_poses: int
    delta: float  # the interval
    unit: str  # "s" or "frame"
    stamp: np.ndarray = field(repr=False)  # (N,) [s] of the later pose
    translation: np.ndarray = field(repr=False)  # (N,) [m]
    rotation_deg: np.ndarray = field(repr=False)  # (N,) [degrees]

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain values; the unprefixed ones are the translation's."""
        return {
            "name": self.name,
            "stage": self.stage,
            "delta": self.delta,
            "unit": self.unit,
            **statistics(self.translation),
            **{f"rotation_{key}_deg": value for key, value in statistics(self.rotation_deg).items()},
            "n_pairs": len(self.stamp),
            "n_poses": self.n_poses,
            "n_frames": self.n_frames,
            "coverage": self.n_poses / self.n_frames if self.n_frames else 0.0,
        }


def rmse(error: np.ndarray) -> float:
    """Compute the root of the mean squared error, [Z] (16), of errors (N,)."""
    return float(np.sqrt(np.mean(np.square(error))))


def statistics(error: np.ndarray) -> dict[str, float]:
    """Summarize errors (N,)."""
    return {
        "rmse": rmse(error),
        "mean": float(np.mean(error)),
        "median": float(np.median(error)),
        "std": float(np.std(error)),
        "min": float(np.min(error)),
        "max": float(np.max(error)),
    }


def matched_pair(estimate: Trajectory, truth: Trajectory, *, name: str) -> tuple[Trajectory, Trajectory]:
    """Reduce both trajectories to the poses they share in time; SlamError when these are too few to align."""
    if len(estimate.stamp) < 3:
        raise SlamError(f"{name}: {len(estimate.stamp)} poses are too few to align, at least 3 are needed")
    rows = associate(estimate.stamp, truth.stamp)
    if len(rows) < 3:
        raise SlamError(
            f"{name}: only {len(rows)} of {len(estimate.stamp)} poses are within {MAX_DIFFERENCE:g} s of a true pose, at least 3 are "
            f"needed; poses span {_span(estimate.stamp)}, ground truth {_span(truth.stamp)}: "
            "are both stamps in seconds and of the same clock?"
        )
    return _rows(estimate, rows[:, 0]), _rows(truth, rows[:, 1])


def _rows(value: Trajectory, rows: np.ndarray) -> Trajectory:
    """Select poses and make their rotations exact again, as reading them from a file would; evo refuses rotations that are off by 1e-6."""
    T_wc = value.T_wc[rows]
    return Trajectory(stamp=value.stamp[rows], T_wc=se3.from_quaternion(T_wc[:, :3, 3], se3.quaternion_xyzw(T_wc)))


def ape(estimate: Trajectory, truth: Trajectory, *, n_frames: int, name: str, stage: str = "") -> Ape:
    """Measure the absolute pose error; [Z] (15): E_i = Q_i^-1 S T_i with S the rigid motion that aligns best.

    Raises SlamError for fewer than three pairs of poses, and where the poses lie on one line, which leaves S open.
    """
    from evo.core import metrics

    n_poses = len(estimate.stamp)
    estimate, truth = matched_pair(estimate, truth, name=name)
    T_gw, _ = _align(estimate, truth, with_scale=False, name=name)
    aligned = Trajectory(stamp=estimate.stamp, T_wc=T_gw @ estimate.T_wc)
    T_gw_scaled, scale = _align(estimate, truth, with_scale=True, name=name)
    T_scaled = estimate.T_wc.copy()
    T_scaled[:, :3, 3] *= scale
    error = {}
    for key, moved in (("rigid", aligned.T_wc), ("scaled", T_gw_scaled @ T_scaled)):
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((_evo(truth), _evo(Trajectory(stamp=estimate.stamp, T_wc=moved))))
        error[key] = np.asarray(metric.error, dtype=np.float64)
    return Ape(
        name=name,
        stage=stage,
        n_frames=n_frames,
        n_poses=n_poses,
        stamp=estimate.stamp,
        error=error["rigid"],
        x_truth=truth.T_wc[:, :3, 3],
        x_aligned=aligned.T_wc[:, :3, 3],
        T_gw=T_gw,
        scale=scale,
        rmse_scaled=rmse(error["scaled"]),
    )


def rpe(
    estimate: Trajectory, truth: Trajectory, *, frame_stamp: np.ndarray, name: str, stage: str = "", seconds: float | None = RPE_SECONDS
) -> Rpe:
    """Measure the relative pose error over `seconds`, or from one colour frame to the next where that is None.

    frame_stamp : (F,) [s] of all colour frames, so that a pair never spans a lost frame unnoticed
    """
    from evo.core import lie_algebra
    from evo.core.metrics import RPE

    n_poses = len(estimate.stamp)
    estimate, truth = matched_pair(estimate, truth, name=name)
    pairs = _next_frame_pairs(estimate.stamp, frame_stamp) if seconds is None else _interval_pairs(estimate.stamp, seconds)
    if not len(pairs):
        interval = "from one frame to the next" if seconds is None else f"over {seconds:g} s"
        raise SlamError(f"{name}: no two poses to compare {interval}; the poses span {estimate.stamp[-1] - estimate.stamp[0]:.2f} s")
    E = np.stack([RPE.rpe_base(truth.T_wc[i], truth.T_wc[j], estimate.T_wc[i], estimate.T_wc[j]) for i, j in pairs])
    return Rpe(
        name=name,
        stage=stage,
        n_frames=len(frame_stamp),
        n_poses=n_poses,
        delta=1.0 if seconds is None else seconds,
        unit="frame" if seconds is None else "s",
        stamp=estimate.stamp[pairs[:, 1]],
        translation=np.linalg.norm(E[:, :3, 3], axis=1),
        rotation_deg=np.array([abs(lie_algebra.so3_log_angle(E_i[:3, :3], degrees=True)) for E_i in E]),
    )


def _align(estimate: Trajectory, truth: Trajectory, *, with_scale: bool, name: str) -> tuple[np.ndarray, float]:
    """Let evo find the motion (and scale, applied first) that takes the estimate's positions onto the true ones."""
    from evo import EvoException
    from evo.core.geometry import umeyama_alignment

    try:
        R, t, scale = umeyama_alignment(estimate.T_wc[:, :3, 3].T, truth.T_wc[:, :3, 3].T, with_scale)
    except EvoException:
        raise SlamError(
            f"{name}: the alignment is undetermined, as the {len(estimate.stamp)} poses compared lie on one line or one spot; "
            "a longer recording with motion in two directions is needed"
        ) from None
    T_gw = np.eye(4)
    T_gw[:3, :3], T_gw[:3, 3] = R, t
    return T_gw, float(scale)


def _evo(value: Trajectory) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(poses_se3=list(value.T_wc), timestamps=value.stamp)


def _interval_pairs(stamp: np.ndarray, seconds: float) -> np.ndarray:
    """Pair each pose with the one closest to `seconds` later, (N, 2); pairs off by more than a tenth of it are left out."""
    right = np.clip(np.searchsorted(stamp, stamp + seconds), 1, len(stamp) - 1)
    miss = np.abs(stamp[[right - 1, right]] - stamp - seconds)
    later = np.where(miss[0] <= miss[1], right - 1, right)
    is_close = np.abs(stamp[later] - stamp - seconds) <= RPE_TOLERANCE * seconds
    return np.stack([np.flatnonzero(is_close), later[is_close]], axis=1)


def _next_frame_pairs(stamp: np.ndarray, frame_stamp: np.ndarray) -> np.ndarray:
    """Pair poses of neighbouring colour frames, (N, 2)."""
    frame = np.searchsorted(0.5 * (frame_stamp[1:] + frame_stamp[:-1]), stamp)  # the nearest: files round their stamps
    first = np.flatnonzero(np.diff(frame) == 1)
    return np.stack([first, first + 1], axis=1)


def _span(stamp: np.ndarray) -> str:
    return f"{stamp[0]:.3f} to {stamp[-1]:.3f}" if len(stamp) else "nothing"
