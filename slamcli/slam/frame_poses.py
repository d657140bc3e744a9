"""The poses of all frames as tracking finds them, each relative to its reference key frame, and the motion model."""

from dataclasses import dataclass

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.schema import KEY_FRAME, LOST, ON_DEPTH, RELOCALIZED, TRACKED, Tracks
from slamcli.sparse_map.sparse_map import SparseMap

# [1/m^2, 1/rad^2] of a motion that goes on as before, or that the background shows: known within 10 mm and 0.6 degrees.
STEADY_INFORMATION = 1e4 * np.eye(6)
STEADY_REACH = 4.0  # times the last step in time over which the motion is taken to go on: a gap says nothing about the motion within it


@dataclass(frozen=True)
class Location:
    """Where a frame was found in the map, and what holds it there."""

    T_cw: np.ndarray  # (4, 4)
    kf: int  # its reference key frame
    state: int  # TRACKED, ON_DEPTH or RELOCALIZED
    landmark: np.ndarray  # (N,) int32, of each feature of the frame, -1 = none
    n_inliers: int  # landmarks that hold it
    is_anchored: bool = True  # whether every direction of motion was measured; else the frame before lent some
    overlap: float | None = None  # where depth ICP placed it, the share of the reference key frame's depth that it shows


class FramePoses:
    """Each frame's pose relative to a reference key frame: when the map moves, the frame moves along.

    latest : the last frame with a pose; anchored : the last one of which every direction of motion was measured (-1 before the first)
    """

    def __init__(self, sparse_map: SparseMap, stamp: np.ndarray, background: np.ndarray | None = None) -> None:
        """Begin with every frame lost.

        stamp : (F,) [s]
        background : (F, 4, 4) T_wc that drift, but whose motion from frame to frame is right, where it is known beforehand
        """
        n = len(stamp)
        self._kf = sparse_map.kf
        self.stamp, self._background = stamp, background
        self.ref_kf = np.full(n, -1, dtype=np.int32)
        self.T_kc = np.full((n, 4, 4), np.nan)
        self.state = np.full(n, LOST, dtype=np.uint8)
        self.n_inliers = np.zeros(n, dtype=np.int32)
        self.lost_reason: dict[int, str] = {}
        self.latest = self.anchored = -1

    @property
    def has_background(self) -> bool:
        """Say whether the motion from frame to frame is known beforehand."""
        return self._background is not None

    def tracks(self) -> Tracks:
        """Return the poses of all frames as an artefact."""
        return Tracks(ref_kf=self.ref_kf, T_kc=self.T_kc, state=self.state, n_inliers=self.n_inliers)

    def has_pose(self, i: int) -> bool:
        """Say whether there is a frame `i` that is not lost."""
        return i >= 0 and self.ref_kf[i] >= 0

    def T_wc(self, i: int) -> np.ndarray:
        """Compute the pose (4, 4) of a frame that is not lost, under the map as it is now."""
        return product(self._kf.T_wk[self.ref_kf[i]], self.T_kc[i])

    def segment(self, i: int) -> int:
        """Look up the map segment that a frame has its pose in, -1 if it is lost."""
        return -1 if self.ref_kf[i] < 0 else int(self._kf.segment[self.ref_kf[i]])

    def attach(self, i: int, at: Location) -> None:
        """Record the pose of frame `i`, to propagate with its reference key frame."""
        self.ref_kf[i], self.state[i], self.n_inliers[i], self.latest = at.kf, at.state, at.n_inliers, i
        self.T_kc[i] = se3.inverse(product(at.T_cw, self._kf.T_wk[at.kf]))
        self.anchored = i if at.is_anchored else self.anchored
        self.lost_reason.pop(i, None)

    def stay(self, i: int) -> None:
        """Record that frame `i` was taken where the one before it was."""
        before = i - 1
        self.ref_kf[i], self.T_kc[i], self.n_inliers[i], self.latest = self.ref_kf[before], self.T_kc[before], self.n_inliers[before], i
        self.state[i] = ON_DEPTH if self.state[before] == ON_DEPTH else TRACKED
        self.anchored = i if self.anchored == before else self.anchored

    def make_key_frame(self, i: int, kf: int) -> None:
        """Record that frame `i` is key frame `kf` itself."""
        self.ref_kf[i], self.T_kc[i], self.state[i], self.latest, self.anchored = kf, np.eye(4), KEY_FRAME, i, i

    def before(self, i: int, seconds: float) -> int:
        """Find the frame nearest to so many seconds before `i`, of those that were followed up to it without a gap, none recognized anew."""
        p = i - 1
        while self.state[p] != RELOCALIZED and self.stamp[i] - self.stamp[p] < seconds and self.has_pose(p - 1):
            if self.segment(p - 1) != self.segment(p):
                break
            p -= 1
        return p

    def predict(self, i: int, p: int, *, reach: float = STEADY_REACH) -> np.ndarray:
        """Predict T_cw of frame `i` by the background's motion, else as if that from the frame before `p` to frame `p` went on.

        reach : times the time between those two, beyond which the camera is taken to rest where frame `p` saw it
        """
        T_wp = self.T_wc(p)
        if self._background is not None:
            return product(se3.inverse(self._background[i]), self._background[p], se3.inverse(T_wp))
        if not self.has_pose(p - 1) or self.segment(p - 1) != self.segment(p):
            return se3.inverse(T_wp)
        share = (self.stamp[i] - self.stamp[p - 1]) / (self.stamp[p] - self.stamp[p - 1])
        return se3.inverse(se3.interpolate(self.T_wc(p - 1), T_wp, share if share < reach else 1.0))
