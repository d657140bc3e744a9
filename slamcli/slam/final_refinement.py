"""Final refinement: key frames by their depth images, then every frame by landmarks, meet the final map again. Only a batch program can."""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from slamcli.calibration import rolling_shutter
from slamcli.config.options import TrackConfig
from slamcli.estimation.bundle_adjustment import BundleResult
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.parallel import ordered_map
from slamcli.schema import KEY_FRAME, LOST, ON_DEPTH, RELOCALIZED, Rests, Timing, Tracks
from slamcli.slam import rests
from slamcli.slam.depth_tracking import DepthAligner, FramePoints
from slamcli.sparse_map import landmark_pose, map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.guided_matching import Landmarks
from slamcli.sparse_map.sparse_map import SparseMap

SHARED = 30  # landmarks of two key frames whose depth images are aligned too
NEIGHBOURS = 20  # covisible key frames whose landmarks are looked for
LOST_WIDENING = 8.0  # a lost frame's neighbour stands where a frame's fast turn leaves it, some tens of pixels off


@dataclass(frozen=True)
class DepthEdges:
    """What depth images are to say of how key frames lie to one another."""

    points: FramePoints  # of the recording that the map is of
    timing: Timing  # when its depth was measured, and when colour
    most: int  # covisible key frames that each one is aligned with; 0 = none
    weight: float = 1.0  # factor on the information of all edges in the adjustment


def refine_all(
    sparse_map: SparseMap,
    frames: FrameStore,
    tracks: Tracks,
    settings: TrackConfig,
    *,
    depth: DepthEdges,
    iterations: int,
    progress,
    workers: int = 1,
    stands_still: Rests = rests.NONE,
) -> tuple[Tracks, BundleResult | None]:
    """Align the depth images of covisible key frames, adjust the map, and refine every frame against it.

    sparse_map : its map is changed; frames : of the recording that it is of, corrected by what is known of the camera
    iterations : of the adjustment; workers : threads; the result is the same with any number
    stands_still : when the camera does: the frames of a rest get one pose
    Returns the refined tracks, and the evidence of the adjustment, None where nothing ties two key frames together.
    """
    if depth.most:
        T_cd = rolling_shutter.depth_to_colour(frames.features, depth.timing, sparse_map.kf.frame)
        points = depth.points.under(frames.camera)
        DepthAligner(sparse_map, points, points).join_covisible(T_cd, most=depth.most, least=SHARED, workers=workers)
    kfs = np.arange(len(sparse_map.kf), dtype=np.int32)
    result = map_adjustment.adjust(sparse_map, kfs, frames.camera, frames.sensor, max_iterations=iterations, edge_weight=depth.weight)
    tracks = refine_frames(sparse_map, frames, tracks, settings, progress, workers=workers, stands_still=stands_still)
    return move_key_frames(sparse_map, tracks), result


def move_key_frames(sparse_map: SparseMap, tracks: Tracks) -> Tracks:
    """Move each key frame to where its frame stands, landmarks staying, and hang all frames on the key frames again.

    The oldest key frame of each segment is its world's origin: instead of it, all else moves.
    """
    table, has_pose = sparse_map.kf, tracks.ref_kf >= 0
    ref, T_wc = tracks.ref_kf[has_pose], np.full(tracks.T_kc.shape, np.nan)
    T_wc[has_pose] = product(table.T_wk[ref], tracks.T_kc[has_pose])
    for oldest in np.unique(table.segment, return_index=True)[1]:
        shift = product(table.T_wk[oldest], se3.inverse(T_wc[table.frame[oldest]]))
        is_here = table.segment == table.segment[oldest]
        frames = np.flatnonzero(has_pose)[is_here[ref]]
        T_wc[frames] = product(shift, T_wc[frames])
        ids = np.flatnonzero(sparse_map.lm.is_alive & is_here[sparse_map.lm.first_kf])
        sparse_map.lm.xyz[ids] = se3.transform(shift, sparse_map.lm.xyz[ids])
    table.T_wk[:] = T_wc[table.frame]
    T_kc = np.full(T_wc.shape, np.nan)
    T_kc[has_pose] = product(se3.inverse(table.T_wk[ref]), T_wc[has_pose])
    T_kc[table.frame] = np.eye(4)
    return replace(tracks, T_kc=T_kc)


def refine_frames(
    sparse_map: SparseMap,
    frames: FrameStore,
    tracks: Tracks,
    settings: TrackConfig,
    progress,
    *,
    workers: int = 1,
    stands_still: Rests = rests.NONE,
) -> Tracks:
    """Refine every frame against the landmarks around it; lost ones are tried from both sides.

    frames, tracks : of a recording, which may be another than the map is of; workers : threads
    stands_still : when the camera does: the frames of a rest get one pose, of as many as that takes
    A frame keeps its pose where much fewer landmarks agree than before, and a key frame also where so few do that depth held it.
    Returns new Tracks; the map stays as it is.
    """
    refinement = _Refinement(sparse_map, frames, tracks, settings)
    n = len(tracks.state)
    # The few landmarks around a frame on shape would make its pose worse.
    chosen = np.flatnonzero((tracks.state != LOST) & (tracks.state != ON_DEPTH) & ~rests.left_out(stands_still, n))
    # No frame depends on another; those that follow one another on one key frame share the landmarks around it.
    spans = np.split(chosen, np.flatnonzero(np.diff(tracks.ref_kf[chosen])) + 1)
    refined = ordered_map(refinement.again, spans, workers=workers)
    for i, estimate in progress(chain.from_iterable(refined), "final refinement", len(chosen)):
        if estimate is not None:
            refinement.record(i, int(tracks.ref_kf[i]), estimate)
            refinement.is_measured[i] = True
    for order, step in ((range(n), -1), (range(n - 1, -1, -1), 1)):
        for i in order:  # a lost frame begins where its neighbour in time stands
            j = i + step
            is_open = refinement.state[i] == LOST and 0 <= j < n and refinement.ref_kf[j] >= 0
            if is_open and refinement.place(i, refinement.T_wc[j], int(refinement.ref_kf[j]), widening=LOST_WIDENING):
                refinement.place(i, refinement.T_wc[i], int(refinement.ref_kf[i]))
                refinement.state[i] = RELOCALIZED
    refinement.rest(stands_still)
    return Tracks(ref_kf=refinement.ref_kf, T_kc=refinement.T_kc, state=refinement.state, n_inliers=refinement.n_inliers)


class _Refinement:
    """The refinement of frames, and what it found."""

    def __init__(self, sparse_map: SparseMap, frames: FrameStore, tracks: Tracks, settings: TrackConfig) -> None:
        self.sparse_map, self.frames, self.settings = sparse_map, frames, settings
        self.limits = landmark_pose.search_limits(settings)
        self.T_wc = np.full(tracks.T_kc.shape, np.nan)  # each in the world of its segment
        has_pose = tracks.ref_kf >= 0
        self.T_wc[has_pose] = product(sparse_map.kf.T_wk[tracks.ref_kf[has_pose]], tracks.T_kc[has_pose])
        self.ref_kf, self.T_kc = tracks.ref_kf.copy(), tracks.T_kc.copy()
        self.state, self.n_inliers = tracks.state.copy(), tracks.n_inliers.copy()
        self.is_measured = np.zeros(len(tracks.state), dtype=bool)

    def again(self, span: np.ndarray) -> list[tuple[int, PoseEstimate | None]]:
        """Look for frames that stand on one key frame where they stand; returns each with its pose, None if it is not there."""
        if len(span) == 0:
            return []
        landmarks, found = self._landmarks_around(int(self.ref_kf[span[0]])), []
        for i in span.tolist():
            least = self.settings.depth_icp_below if self.state[i] == KEY_FRAME else 0
            found.append((i, self._find(i, self.T_wc[i], landmarks, least=least)))
        return found

    def place(self, i: int, T_wc: np.ndarray, kf: int, *, widening: float = 1.0) -> bool:
        """Look for frame `i` at `T_wc` among the landmarks around key frame `kf`; False, and nothing changes, if it is not there.

        widening : of the search window, where `T_wc` is a guess
        """
        estimate = self._find(i, T_wc, self._landmarks_around(kf), widening=widening)
        if estimate is not None:
            self.record(i, kf, estimate)
        return estimate is not None

    def record(self, i: int, kf: int, estimate: PoseEstimate) -> None:
        """Note where frame `i` was found, relative to key frame `kf`."""
        self.ref_kf[i], self.n_inliers[i] = kf, estimate.n_inliers
        self.T_wc[i] = se3.inverse(estimate.T_cw)
        self.T_kc[i] = se3.inverse(product(estimate.T_cw, self.sparse_map.kf.T_wk[kf]))

    def rest(self, stands_still: Rests) -> None:
        """Give the frames of each rest one pose."""
        has_pose = self.ref_kf >= 0
        segment = np.where(has_pose, self.sparse_map.kf.segment[self.ref_kf], -1)
        T_wc = rests.one_pose(stands_still, self.T_wc, self.is_measured, segment)
        moved = np.flatnonzero(has_pose & (T_wc != self.T_wc).any(axis=(1, 2)))
        self.T_wc[moved] = T_wc[moved]
        self.T_kc[moved] = product(se3.inverse(self.sparse_map.kf.T_wk[self.ref_kf[moved]]), T_wc[moved])

    def _find(self, i: int, T_wc: np.ndarray, landmarks: Landmarks, *, widening: float = 1.0, least: int = 0) -> PoseEstimate | None:
        """Estimate the pose of frame `i` from a guess; None where fewer landmarks agree than the settings, half of before, or `least` say."""
        wanted = max(least, self.settings.min_inliers, int(self.n_inliers[i]) // 2)
        found = landmark_pose.find(se3.inverse(T_wc), landmarks, self.frames[i], self.limits.widened(widening), wanted=wanted)
        return found.estimate if found.n_agree >= wanted else None

    def _landmarks_around(self, kf: int) -> Landmarks:
        neighbours, _ = self.sparse_map.covisible(kf)
        return self.sparse_map.landmarks(self.sparse_map.landmarks_in(np.append(neighbours[:NEIGHBOURS], kf)))
