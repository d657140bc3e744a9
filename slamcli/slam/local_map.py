"""The local map: a frame meets all landmarks of the key frames around it, and its pose is refined on those found; [Z] 1.2."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.sparse_map import landmark_pose
from slamcli.sparse_map.guided_matching import FrameFeatures, Landmarks
from slamcli.sparse_map.sparse_map import SparseMap


@dataclass(frozen=True)
class MapMatch:
    """A frame's pose in the map and the landmarks that it rests on."""

    estimate: PoseEstimate
    landmark: np.ndarray  # (N,) int32, of each feature of the frame, -1 = none


class LocalMap:
    """Matches frames with the landmarks around them."""

    def __init__(self, sparse_map: SparseMap, settings: TrackConfig) -> None:
        self._sparse_map, self._settings = sparse_map, settings
        self._last = _Around(b"", np.empty(0, dtype=np.int32), sparse_map.landmarks(np.empty(0, dtype=np.int32)))

    def match(self, frame: FrameFeatures, T_cw: np.ndarray, ids: np.ndarray, *, wanted: int) -> MapMatch | None:
        """Search the frame near pose `T_cw` for the landmarks around `ids`, and refine its pose; None if fewer than `wanted` agree.

        Associations are made anew from the landmarks' own descriptors: handed on from frame to frame they would creep. The map counts
        how often each landmark was visible and found.
        """
        around, lm = self._landmarks_around(ids), self._sparse_map.lm
        local = around.ids
        limits, enough = landmark_pose.search_limits(self._settings), 2 * self._settings.min_inliers
        found = landmark_pose.find(T_cw, around.landmarks, frame, limits, wanted=wanted, enough=enough)
        if found.estimate is None or found.estimate.n_inliers < wanted:
            return None
        agrees = found.estimate.is_inlier
        landmark = np.full(len(frame), -1, dtype=np.int32)
        landmark[found.feature[agrees]] = local[found.landmark[agrees]]
        lm.n_visible[local[found.is_visible]] += 1
        lm.n_found[local[found.landmark[agrees]]] += 1
        return MapMatch(found.estimate, landmark)

    def _landmarks_around(self, ids: np.ndarray) -> "_Around":
        """Gather the landmarks of the key frames that see most of `ids`, and of those most covisible with the first of these.

        The map changes with a key frame and not between, and frames that follow one another mostly have the same ones around them.
        """
        sparse_map, most = self._sparse_map, self._settings.local_key_frames
        votes = sparse_map.votes(np.unique(ids))
        order = np.argsort(-votes, kind="stable")
        chosen = order[: min(most, np.count_nonzero(votes))]
        size = np.array([len(sparse_map.kf), len(sparse_map.obs), *chosen[:1]])
        key = np.concatenate([size, np.sort(chosen)]).tobytes()
        if key != self._last.key:
            local = np.empty(0, dtype=np.int32)
            if len(chosen):
                neighbours, _ = sparse_map.covisible(int(chosen[0]))
                local = sparse_map.landmarks_in(np.union1d(chosen, neighbours[: most // 2]))
            self._last = _Around(key, local, sparse_map.landmarks(local))
        return self._last


@dataclass(frozen=True)
class _Around:
    """The landmarks around a frame."""

    key: bytes  # by which to know them again: the size of the map, and the key frames that they come from
    ids: np.ndarray  # (N,) int32
    landmarks: Landmarks
