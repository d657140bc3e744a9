"""Every frame refined against the landmarks of the final map around it, and lost ones looked for again where their neighbours stand."""

from itertools import chain

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.parallel import ordered_map
from slamcli.schema import KEY_FRAME, LOST, ON_DEPTH, RELOCALIZED, Rests, Tracks
from slamcli.slam import rests
from slamcli.slam.recording import TrackedRecording
from slamcli.sparse_map import landmark_pose
from slamcli.sparse_map.guided_matching import Landmarks
from slamcli.sparse_map.sparse_map import SparseMap

NEIGHBOURS = 20  # covisible key frames whose landmarks are looked for
AT_ONCE = 64  # frames of one key frame that a thread refines, so that the others find work, too
LOST_WIDENING = 8.0  # a lost frame's neighbour stands where a frame's fast turn leaves it, some tens of pixels off


def refine_frames(sparse_map: SparseMap, tracked: TrackedRecording, settings: TrackConfig, progress, *, workers: int = 1) -> Tracks:
    """Refine every frame against the landmarks around it; lost ones are tried from both sides.

    tracked : a recording, which may be another than the map is of; workers : threads
    The frames of a rest get one pose, of as many as that takes.
    A frame keeps its pose where much fewer landmarks agree than before, and a key frame also where so few do that depth held it.
    Returns new Tracks; the map stays as it is.
    """
    refinement = _FrameRefinement(sparse_map, tracked, settings)
    refinement.refine_known(~rests.left_out(tracked.stands_still, len(tracked.frames)), progress, workers=workers)
    refinement.find_lost()
    refinement.unite_rests(tracked.stands_still)
    return refinement.tracks()


class _FrameRefinement:
    """The poses of frames, refined one after the other."""

    def __init__(self, sparse_map: SparseMap, tracked: TrackedRecording, settings: TrackConfig) -> None:
        self._sparse_map, self._frames, self._settings, tracks = sparse_map, tracked.frames, settings, tracked.tracks
        self._limits = landmark_pose.search_limits(settings)
        self._T_wc = np.full(tracks.T_kc.shape, np.nan)  # each in the world of its segment
        has_pose = tracks.ref_kf >= 0
        self._T_wc[has_pose] = product(sparse_map.kf.T_wk[tracks.ref_kf[has_pose]], tracks.T_kc[has_pose])
        self._ref_kf, self._T_kc = tracks.ref_kf.copy(), tracks.T_kc.copy()
        self._state, self._n_inliers = tracks.state.copy(), tracks.n_inliers.copy()
        self._is_measured = np.zeros(len(tracks.state), dtype=bool)

    def tracks(self) -> Tracks:
        """Return the poses as they are now."""
        return Tracks(ref_kf=self._ref_kf, T_kc=self._T_kc, state=self._state, n_inliers=self._n_inliers)

    def refine_known(self, is_wanted: np.ndarray, progress, *, workers: int) -> None:
        """Refine those of the frames wanted (F,) that landmarks hold."""
        # The few landmarks around a frame on depth would make its pose worse.
        chosen = np.flatnonzero((self._state != LOST) & (self._state != ON_DEPTH) & is_wanted)
        # No frame depends on another; those that stand on one key frame, whenever that was, share the landmarks around it.
        chosen = chosen[np.argsort(self._ref_kf[chosen], kind="stable")]
        of_each = np.split(chosen, np.flatnonzero(np.diff(self._ref_kf[chosen])) + 1)
        groups = [group[k : k + AT_ONCE] for group in of_each for k in range(0, len(group), AT_ONCE)]
        refined = ordered_map(self._refine_group, groups, workers=workers)
        for i, estimate in progress(chain.from_iterable(refined), "final refinement", len(chosen)):
            if estimate is not None:
                self._record(i, int(self._ref_kf[i]), estimate)
                self._is_measured[i] = True

    def find_lost(self) -> None:
        """Look for each lost frame where its neighbour in time stands, first the one before it, then the one after."""
        n = len(self._state)
        for order, step in ((range(n), -1), (range(n - 1, -1, -1), 1)):
            for i in order:
                j = i + step
                is_open = self._state[i] == LOST and 0 <= j < n and self._ref_kf[j] >= 0
                if is_open and self._place(i, self._T_wc[j], int(self._ref_kf[j]), widening=LOST_WIDENING):
                    self._place(i, self._T_wc[i], int(self._ref_kf[i]))
                    self._state[i] = RELOCALIZED

    def unite_rests(self, stands_still: Rests) -> None:
        """Give the frames of each rest one pose."""
        has_pose = self._ref_kf >= 0
        segment = np.where(has_pose, self._sparse_map.kf.segment[self._ref_kf], -1)
        T_wc = rests.one_pose(stands_still, self._T_wc, self._is_measured, segment)
        moved = np.flatnonzero(has_pose & (T_wc != self._T_wc).any(axis=(1, 2)))
        self._T_wc[moved] = T_wc[moved]
        self._T_kc[moved] = product(se3.inverse(self._sparse_map.kf.T_wk[self._ref_kf[moved]]), T_wc[moved])

    def _refine_group(self, group: np.ndarray) -> list[tuple[int, PoseEstimate | None]]:
        """Look for frames that stand on one key frame where they stand; returns each with its pose, None if it is not there."""
        landmarks, found = self._landmarks_around(int(self._ref_kf[group[0]])), []
        for i in group.tolist():
            least = self._settings.depth_icp_below if self._state[i] == KEY_FRAME else 0
            found.append((i, self._find(i, self._T_wc[i], landmarks, least=least)))
        return found

    def _place(self, i: int, T_wc: np.ndarray, kf: int, *, widening: float = 1.0) -> bool:
        """Look for frame `i` at `T_wc` among the landmarks around key frame `kf`; False, and nothing changes, if it is not there.

        widening : of the search window, where `T_wc` is a guess
        """
        estimate = self._find(i, T_wc, self._landmarks_around(kf), widening=widening)
        if estimate is not None:
            self._record(i, kf, estimate)
        return estimate is not None

    def _find(self, i: int, T_wc: np.ndarray, landmarks: Landmarks, *, widening: float = 1.0, least: int = 0) -> PoseEstimate | None:
        """Estimate the pose of frame `i` from a guess; None where fewer landmarks agree than the settings, half of before, or `least` say."""
        wanted = max(least, self._settings.min_inliers, int(self._n_inliers[i]) // 2)
        found = landmark_pose.find(se3.inverse(T_wc), landmarks, self._frames[i], self._limits.widened(widening), wanted=wanted)
        return found.estimate if found.n_agree >= wanted else None

    def _landmarks_around(self, kf: int) -> Landmarks:
        neighbours, _ = self._sparse_map.covisible(kf)
        return self._sparse_map.landmarks(self._sparse_map.landmarks_in(np.append(neighbours[:NEIGHBOURS], kf)))

    def _record(self, i: int, kf: int, estimate: PoseEstimate) -> None:
        """Note where frame `i` was found, relative to key frame `kf`."""
        self._ref_kf[i], self._n_inliers[i] = kf, estimate.n_inliers
        self._T_wc[i] = se3.inverse(estimate.T_cw)
        self._T_kc[i] = se3.inverse(product(estimate.T_cw, self._sparse_map.kf.T_wk[kf]))
