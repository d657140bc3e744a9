"""A key frame joins the map: new landmarks, doubtful ones culled, landmarks shared with key frames around, the window adjusted; [Z] 1.2."""

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.geometry import se3
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.landmark_fusion import fuse_landmarks
from slamcli.sparse_map.sparse_map import SparseMap

# A new landmark is on probation for so many key frames, as ORB-SLAM2 does (doi:10.1109/TRO.2017.2705103): it goes when it is found in
# less than a quarter of the frames that should see it, or when no second key frame has seen it after two.
PROBATION = 3
MIN_FOUND = 0.25
SECOND_VIEW_AFTER = 2
COVISIBLE = 15  # landmarks that two key frames share at least, to count as neighbours


class MapGrowth:
    """Adds key frames to the map."""

    def __init__(self, sparse_map: SparseMap, frames: FrameStore, settings: TrackConfig) -> None:
        """Take the map and the frames of the recording that it is of."""
        self._sparse_map, self._frames, self._settings = sparse_map, frames, settings
        self._on_probation = np.empty(0, dtype=np.int32)  # landmarks

    def insert(self, i: int, frame: FrameFeatures, T_wc: np.ndarray, landmark: np.ndarray, segment: int) -> tuple[int, np.ndarray]:
        """Make frame `i` a key frame: note what it sees of the map, and add a landmark for every other feature with depth.

        landmark : (N,) of each feature, -1 = none
        Returns the key frame and the landmarks added; `cull_share_adjust` does the rest.
        """
        sparse_map = self._sparse_map
        kf = sparse_map.add_key_frame(i, T_wc, segment)
        known = np.flatnonzero(landmark >= 0)
        sparse_map.observe(kf, landmark[known], frame.first_row + known)
        new = np.flatnonzero((landmark < 0) & np.isfinite(frame.depth))
        x_w = se3.transform(T_wc, frame.camera.backproject(frame.xy[new], frame.depth[new]))
        return kf, sparse_map.add_landmarks(kf, frame.first_row + new, x_w)

    def cull_share_adjust(self, kf: int, added: np.ndarray, known: np.ndarray) -> None:
        """Cull what was not found again, share the landmarks `added` with the key frames around, and adjust the window.

        known : landmarks that were there before and that `kf` sees
        """
        self.cull(kf)
        self._on_probation = np.concatenate([self._on_probation, added])
        self._share_with_neighbours(kf, added)
        self._sparse_map.refresh(known)
        self._adjust_window(kf)

    def cull(self, kf: int) -> None:
        """Remove landmarks on probation that frames up to key frame `kf` seldom found, or that no second key frame saw."""
        lm = self._sparse_map.lm
        ids = self._sparse_map.resolve(self._on_probation)
        ids = np.unique(ids[ids >= 0])
        age = kf - lm.first_kf[ids]
        is_bad = (lm.n_found[ids] < MIN_FOUND * lm.n_visible[ids]) | ((age >= SECOND_VIEW_AFTER) & (lm.n_obs[ids] < 2))
        self._sparse_map.remove_landmarks(ids[is_bad])
        self._on_probation = ids[~is_bad & (age < PROBATION)]

    def _share_with_neighbours(self, kf: int, added: np.ndarray) -> None:
        """Look for the new landmarks in the key frames around: a free feature becomes a view, a landmark there is fused."""
        neighbours, shared = self._sparse_map.covisible(kf)
        most = self._settings.share_key_frames
        for other in neighbours[:most][shared[:most] >= COVISIBLE]:
            ids = added[self._sparse_map.lm.is_alive[added]]
            fuse_landmarks(self._sparse_map, int(other), ids, self._frames, max_distance=self._settings.share_max_distance)

    def _adjust_window(self, kf: int) -> None:
        neighbours, shared = self._sparse_map.covisible(kf)
        covisible = neighbours[shared >= COVISIBLE][: self._settings.window_key_frames - 1]
        window = np.union1d(covisible, self._sparse_map.joined_by_edges(np.array([kf])))
        if len(window) == 0:
            return
        map_adjustment.adjust(
            self._sparse_map,
            np.sort(np.append(window, kf)).astype(np.int32),
            self._frames.camera,
            self._frames.sensor,
            max_iterations=self._settings.window_iterations,
        )
