"""Where a run's frames lie to each other, and where its camera began and ended: what a robot is told to start from."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.navigation.robot_pose import planar_pose
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Ground, Map, Tracks, frame_poses


@dataclass(frozen=True)
class Placement:
    """The level frame, and the camera's first and last pose on the floor."""

    T_lw: np.ndarray  # (4, 4) world to level frame
    is_floor_found: bool
    first: tuple[float, float, float]  # x [m], y [m], heading [rad] of the first frame with a pose, level frame
    last: tuple[float, float, float]  # of the last one

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: T_lw by rows, poses as x, y [m], yaw [rad]."""
        poses = {
            name: dict(zip(("x", "y", "yaw"), _rounded(pose), strict=True)) for name, pose in (("first", self.first), ("last", self.last))
        }
        return {"T_lw": self.T_lw.tolist(), "is_floor_found": self.is_floor_found, **poses}


def read(run: RunDir) -> Placement:
    """Read a run's placement; SlamError where densify has not been run, or no frame has a pose."""
    ground = run.load(Ground, "densify")
    T_lc = ground.T_lw @ camera_poses(run)
    if len(T_lc) == 0:
        raise SlamError(f"{run.path}: no frame has a pose")
    return Placement(ground.T_lw, bool(ground.is_found), planar_pose(T_lc[0]), planar_pose(T_lc[-1]))


def camera_poses(run: RunDir) -> np.ndarray:
    """Return T_wc (N, 4, 4) of the frames that have a pose, in the order of time."""
    T_wc = frame_poses(run.load(Tracks, "loop"), run.load(Map, "loop"))
    return T_wc[np.isfinite(T_wc[:, 0, 0])]


def camera_path(run: RunDir) -> np.ndarray:
    """Return the camera centres (N, 3) in the level frame [m], in the order of time; a row of NaN where lost and between recordings."""
    return np.insert(level_poses(run)[:, :3, 3], beginnings(run)[1:], np.nan, axis=0)


def beginnings(run: RunDir) -> np.ndarray:
    """Return the first frame of each recording of a run (R,), which loop brought into one frame: 0 of one recording."""
    placed = (run.record("loop") or {}).get("summary", {}).get("recordings", [])
    return np.cumsum([0] + [row["frames"] for row in placed[:-1]], dtype=np.int64)


def level_poses(run: RunDir) -> np.ndarray:
    """Return T_lc (F, 4, 4) of every frame, NaN where lost."""
    return run.load(Ground, "densify").T_lw @ frame_poses(run.load(Tracks, "loop"), run.load(Map, "loop"))


def lines(placement: Placement) -> list[tuple[str, str]]:
    """Tell the start pose and T_lw, each with its name."""
    x, y, yaw = _rounded(placement.first)
    numbers = np.concatenate([placement.T_lw[:3, 3], se3.quaternion_xyzw(placement.T_lw)])
    level = " ".join(f"{value:.4f}" for value in numbers + 0.0)
    return [
        ("start", f"x {x:.2f} m, y {y:.2f} m, yaw {yaw:.3f} rad in the maps' frame"),
        ("T_lw", f"{level} (t, q xyzw)"),
    ]


def _rounded(pose: tuple[float, float, float]) -> tuple[float, float, float]:
    """Round to what can be told apart; 0.0 is added as -0.0 would puzzle."""
    x, y, yaw = pose
    return round(x, 3) + 0.0, round(y, 3) + 0.0, round(yaw, 4) + 0.0
