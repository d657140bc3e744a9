"""The local map: a frame meets all landmarks of the key frames around it, and its pose is refined on those found; [Z] 1.2."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry.camera import Camera
from slamcli.sparse_map import guided_matching
from slamcli.sparse_map.frame import refine_on_landmarks
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import SparseMap

WIDER = 3.0  # times the search radius, where the first search finds little


@dataclass(frozen=True)
class MapMatch:
    """A frame's pose in the map and the landmarks that it rests on."""

    estimate: PoseEstimate
    landmark: np.ndarray  # (N,) int32, of each feature of the frame, -1 = none


class LocalMap:
    """Matches frames with the landmarks around them."""

    def __init__(self, sparse_map: SparseMap, camera: Camera, settings: TrackConfig) -> None:
        self._sparse_map, self._camera, self._settings = sparse_map, camera, settings

    def match(self, frame: FrameFeatures, T_cw: np.ndarray, ids: np.ndarray, *, wanted: int) -> MapMatch | None:
        """Search the frame near pose `T_cw` for the landmarks around `ids`, and refine its pose; None if fewer than `wanted` agree.

        Associations are made anew from the landmarks' own descriptors: handed on from frame to frame they would creep. The map counts
        how often each landmark was visible and found.
        """
        sparse_map, settings = self._sparse_map, self._settings
        local = self._landmarks_around(ids)
        candidates = sparse_map.landmarks(local)
        for radius in (settings.search_radius_px, WIDER * settings.search_radius_px):
            feature, is_visible = guided_matching.search(
                T_cw,
                candidates,
                frame,
                self._camera,
                octave_scale=sparse_map.octave_scale,
                radius_px=radius,
                max_distance=settings.search_max_distance,
                ratio=settings.search_ratio,
            )
            which = np.flatnonzero(feature >= 0)
            if len(which) >= 2 * settings.min_inliers:
                break
        if len(which) < wanted:
            return None
        estimate = refine_on_landmarks(T_cw, candidates.xyz[which], frame, feature[which], self._camera)
        if estimate.n_inliers < wanted:
            return None
        landmark = np.full(len(frame), -1, dtype=np.int32)
        agreed = which[estimate.is_inlier]
        landmark[feature[agreed]] = local[agreed]
        sparse_map.lm.n_visible[local[is_visible]] += 1
        sparse_map.lm.n_found[local[agreed]] += 1
        return MapMatch(estimate, landmark)

    def _landmarks_around(self, ids: np.ndarray) -> np.ndarray:
        """List the landmarks of the key frames that see most of `ids`, and of those most covisible with the first of these."""
        votes = self._sparse_map.votes(np.unique(ids))
        order = np.argsort(-votes, kind="stable")
        chosen = order[: min(self._settings.local_key_frames, np.count_nonzero(votes))]
        if len(chosen) == 0:
            return np.empty(0, dtype=np.int32)
        neighbours, _ = self._sparse_map.covisible(int(chosen[0]))
        chosen = np.union1d(chosen, neighbours[: self._settings.local_key_frames // 2])
        return self._sparse_map.landmarks_in(chosen)
