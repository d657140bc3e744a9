"""Depth images with the poses of the camera that took them: what densify, octree and grid2d are made from."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from slamcli.calibration import rolling_shutter
from slamcli.datasets import Dataset
from slamcli.errors import BadFrame
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.parallel import ordered_map
from slamcli.schema import FrameTimes, Map, Moving, Tracks, frame_poses
from slamcli.stages.contract import Inputs, Stored, Tools
from slamcli.stages.measurements import depth_times
from slamcli.stages.moving_parts import NOTHING, still_depth

FOOT = 0.05  # [m] side of the places on the floor that what stands on them takes
NEAR = 10.0  # [m] from the camera, farther than which no floor is looked for around what moves

Seen = TypeVar("Seen")
PosedFrame = tuple[int, np.ndarray]  # a frame's number, and its pose (4, 4), camera to some frame, when its depth was measured


def depth_poses(inputs: Stored, *, frames: str = "key") -> list[PosedFrame]:
    """List frames of the main map segment with the pose of the camera, in the world, when their depth was measured.

    frames : "key" frames, or "all" that have a pose
    """
    times, map_ = inputs.load(FrameTimes, "loop"), inputs.load(Map, "loop")
    T_wc = frame_poses(inputs.load(Tracks, "loop"), map_)
    is_main = map_.kf_segment == 0
    T_wc[map_.kf_frame[is_main]] = map_.T_wk[is_main]
    T_wd = rolling_shutter.depth_poses(times.stamp, depth_times(inputs, times), T_wc)
    chosen = map_.kf_frame[is_main] if frames == "key" else np.flatnonzero(np.isfinite(T_wd[:, 0, 0]))
    return [(int(frame), T_wd[frame]) for frame in chosen]


def say_nothing(message: str) -> None:
    """Pass over what there is to warn of."""


@dataclass(frozen=True)
class DepthFrames:
    """A recording's depth images as the maps are made from them: undistorted, without what moves."""

    dataset: Dataset
    camera: Camera
    moving: Moving = NOTHING
    workers: int = 1  # threads that read
    warn: Callable[[str], None] = say_nothing  # told of frames that cannot be read

    @classmethod
    def of(cls, inputs: Inputs, tools: Tools) -> "DepthFrames":
        """Return those of the recording that a stage works on, as loop left its camera and what moves."""
        return cls(inputs.dataset, inputs.camera("loop"), inputs.load(Moving, "loop"), tools.workers, tools.warn)

    def look_at(
        self, poses: Iterable[PosedFrame], look: Callable[[int, np.ndarray, np.ndarray], Seen], *, floor: float | None = None
    ) -> Iterator[Seen]:
        """Read frames, in order, and hand each to `look(frame, depth, pose)` in a worker thread; yields what that returns.

        depth : (H, W) float32 [m], NaN = none and where something moves. A frame without depth, or that cannot be read, yields nothing.
        floor : [m] what is no farther above or below the level z = 0 that the poses lead to is kept also where something moves: the floor
            shows at the feet of those who walk on it. None = there is no such level
        """

        def seen(posed: PosedFrame) -> Seen | None:
            frame, pose = posed
            try:
                depth = self.dataset.depth(frame, self.camera)
                return None if depth is None else look(frame, self._still(depth, frame, pose, floor), pose)
            except BadFrame as error:
                self.warn(str(error))
                return None

        return (found for found in ordered_map(seen, poses, workers=self.workers) if found is not None)

    def _still(self, depth: np.ndarray, frame: int, pose: np.ndarray, floor: float | None) -> np.ndarray:
        still = still_depth(depth, self.moving, frame, self.camera)
        if floor is None or still is depth:
            return still
        v, u = np.nonzero(np.isnan(still) & (depth <= NEAR))
        xyz = se3.transform(pose, np.column_stack([depth[v, u, None] * self.camera.rays[v, u], depth[v, u]]))
        is_floor = np.abs(xyz[:, 2]) <= floor
        is_floor[is_floor] &= ~_under(xyz[~is_floor, :2], xyz[is_floor, :2])
        still[v[is_floor], u[is_floor]] = depth[v[is_floor], u[is_floor]]
        return still


def _under(hidden: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Say which places (N, 2) [m] lie under one of those (M, 2) that are hidden: what stands there is no floor, moving or not."""
    if not len(hidden) or not len(xy):
        return np.zeros(len(xy), dtype=bool)
    cell, low = np.floor(xy / FOOT).astype(np.int64), np.floor(xy.min(axis=0) / FOOT).astype(np.int64)
    is_taken = np.zeros(cell.max(axis=0) - low + 1, dtype=bool)
    above = np.floor(hidden / FOOT).astype(np.int64) - low
    inside = ((above >= 0) & (above < is_taken.shape)).all(axis=1)
    is_taken[tuple(above[inside].T)] = True
    return is_taken[tuple((cell - low).T)]
