"""Build a map from one frame after the other: find the pose, decide on a key frame, begin a new segment where tracking is lost for good."""

from collections.abc import Iterator

import numpy as np

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.schema import KEY_FRAME, LOST, ON_SHAPE, TRACKED, Features, Map, Matches, Words
from slamcli.slam.depth_tracking import Reliefs
from slamcli.slam.localizer import NO_RELIEFS, Localiser, frame_features, word_vector
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import MapBuilder

SHAPE_M, SHAPE_RAD = 0.3, 0.26  # a frame on shape that has moved or turned so far from its key frame becomes one
CROWD_M, CROWD_COSINE = 0.1, 0.9945  # key frames nearer than this, and turned by less than 6 degrees, stand in the same place


class Tracker(Localiser):
    """Builds the map that it finds the frames in; `map()` gives it.

    Where a frame is lost and not recognised for a while, a new segment of the map begins, with a world frame of its own. Segments are
    joined later, by places that both saw.
    """

    def __init__(
        self,
        features: Features,
        words: Words,
        matches: Matches,
        camera: Camera,
        settings: TrackConfig,
        sensor: SensorConfig,
        rng: np.random.Generator,
        *,
        reliefs: Reliefs = NO_RELIEFS,
    ):
        builder = MapBuilder(features)
        super().__init__(
            builder, words, features, words, matches, camera, settings, sensor, rng, reliefs=reliefs, map_reliefs=reliefs
        )  # fmt: skip
        self.segment = -1  # that frames are added to; -1 before the first
        self._n_lost = 0  # frames in a row that saw enough and were not recognised
        self._first_lost = -1  # of these
        self._recent = np.empty(0, dtype=np.int32)  # landmarks still on probation

    def process(self, i: int) -> None:
        """Track frame `i`; frames come in order."""
        frame = frame_features(self.features, i, self.camera, self.sensor)
        if self.segment < 0:
            lm_of = self._start_segment(i, frame)
        else:
            lm_of = self._locate(i, frame)
            if self.state[i] == LOST:
                lm_of = self._lose(i, frame)
            else:
                self._n_lost, self.segment = 0, self.segment_of(i)
                if self._wants_key_frame(i, frame, lm_of):
                    lm_of = self._add_key_frame(i, frame, self.pose_of(i), lm_of)
        self._previous, self._lm_of_previous = frame, lm_of

    def map(self) -> Map:
        """Give the map built so far."""
        return self.builder.snapshot()

    def _lose(self, i: int, frame: FrameFeatures) -> np.ndarray:
        """Count a lost frame; after too many that could have been recognised, begin a new segment. Returns the landmarks of its features."""
        if len(frame) >= self.settings.min_inliers or self.shape.fixes_all(i):
            self._first_lost = i if self._n_lost == 0 else self._first_lost
            self._n_lost += 1
        if 0 < self.settings.segment_after <= self._n_lost:
            return self._begin_again(i)
        return np.full(len(frame), -1, dtype=np.int32)

    def _begin_again(self, last: int) -> np.ndarray:
        """Begin a new segment with the first lost frame, nearest to what was seen before, and track those after it up to `last` anew."""
        for i in range(self._first_lost, last + 1):
            frame = frame_features(self.features, i, self.camera, self.sensor)
            self._previous, self._lm_of_previous = frame, self._start_segment(i, frame)
            if self.state[i] == KEY_FRAME:
                break
        for later in range(i + 1, last + 1):
            self.process(later)
        return self._lm_of_previous

    def _references(self, i: int, T_cw: np.ndarray) -> Iterator[int]:
        """Give the key frames that frame `i` may be aligned with; where the first does not do, the frame before becomes one.

        That shows most of what frame `i` does, and the less the two views part, the better a motion is determined.
        """
        references = super()._references(i, T_cw)
        yield next(references)
        if self._surely == i - 1 and self.state[i - 1] in (TRACKED, ON_SHAPE):
            self._lm_of_previous = self._add_key_frame(i - 1, self._previous, self.pose_of(i - 1), self._lm_of_previous)
            yield int(self.ref_kf[i - 1])
        yield from references

    def _start_segment(self, i: int, frame: FrameFeatures) -> np.ndarray:
        """Make frame `i` the first key frame of a new segment if it sees enough with depth."""
        nothing = np.full(len(frame), -1, dtype=np.int32)
        n_depth = int(np.isfinite(frame.depth).sum())
        if n_depth < self.settings.start_features and not self.shape.fixes_all(i):
            if self.segment < 0:
                seen = f"{len(frame)} features, {n_depth} with depth, {self.settings.start_features} wanted"
                self.lost_reason[i] = f"no map yet: {seen}, and depth shows too little shape to begin with"
            return nothing
        self.segment, self._n_lost = len(np.unique(self.builder.kf.segment)), 0
        self.lost_reason.pop(i, None)
        return self._add_key_frame(i, frame, np.eye(4), nothing)

    # -- key frames ---------------------------------------------------------------------------------------------------------------

    def _wants_key_frame(self, i: int, frame: FrameFeatures, lm_of: np.ndarray) -> bool:
        """Decide as ORB-SLAM2 does: too little of the reference key frame is left in view, or much new surface is near."""
        has_depth = np.isfinite(frame.depth)
        tracked = lm_of >= 0
        if self.state[i] == ON_SHAPE:
            return self._leaves_shape(i)
        if has_depth.sum() < self.settings.min_inliers:
            return False
        kf = self.ref_kf[i]
        seen = self.builder.landmarks_of(kf)
        n_reference = np.count_nonzero(self.builder.lm.n_obs[seen] >= min(2, np.count_nonzero(self.builder.kf.segment == self.segment)))
        leaves_reference = tracked.sum() < self.settings.key_frame_share * n_reference
        meets_new_surface = (tracked & has_depth).sum() < 100 and (~tracked & has_depth).sum() > 70
        is_overdue = i - self.builder.kf.frame[-1] >= self.settings.key_frame_gap
        return bool(meets_new_surface or ((leaves_reference or is_overdue) and not self._is_crowded(i)))

    def _leaves_shape(self, i: int) -> bool:
        """Say whether frame `i` shows too little of the key frame that it was aligned with, or sees it from elsewhere."""
        if self._surely < i:
            return False  # what rests on it would share its error
        motion = se3.log(self.T_kc[i])
        is_far = np.linalg.norm(motion[:3]) > SHAPE_M or np.linalg.norm(motion[3:]) > SHAPE_RAD
        return bool(is_far or self._placement.alignment.overlap < self.settings.key_frame_share)

    def _is_crowded(self, i: int) -> bool:
        """Say whether so many key frames stand where frame `i` does that another would only make the map, and every later frame, dearer."""
        kf, T_wc = self.builder.kf, self.pose_of(i)
        is_here = (kf.segment == self.segment) & (np.linalg.norm(kf.T_wk[:, :3, 3] - T_wc[:3, 3], axis=1) < CROWD_M)
        is_here &= kf.T_wk[:, :3, 2] @ T_wc[:3, 2] > CROWD_COSINE
        return np.count_nonzero(is_here) >= self.settings.key_frame_crowd

    def _add_key_frame(self, i: int, frame: FrameFeatures, T_wc: np.ndarray, lm_of: np.ndarray) -> np.ndarray:
        """Make frame `i` a key frame, grow the map by what it sees, and adjust the window around it."""
        builder = self.builder
        kf = builder.add_key_frame(i, T_wc, self.segment)
        known = np.flatnonzero(lm_of >= 0)
        builder.observe(kf, lm_of[known], frame.first_row + known)
        new = np.flatnonzero((lm_of < 0) & np.isfinite(frame.depth))
        x_w = se3.transform(T_wc, self.camera.backproject(frame.xy[new], frame.depth[new]))
        added = builder.add_landmarks(kf, frame.first_row + new, x_w)
        self.places.add(kf, *word_vector(self.words, i))
        # Landmarks enough to recognise a place by hold the key frame; shape alone might slide along a corridor.
        if self.state[i] == ON_SHAPE and len(known) < self.settings.relocalise_inliers:
            self.shape.join(kf)
        self.ref_kf[i], self.T_kc[i], self.state[i], self._latest, self._surely = kf, np.eye(4), KEY_FRAME, i, i
        self._cull(kf)
        self._recent = np.concatenate([self._recent, added])
        self._share_with_neighbours(kf, added)
        builder.refresh(lm_of[known])
        self._adjust_window(kf)
        return builder.resolve(builder.lm_of_row[builder.rows_of(kf)])

    def _cull(self, kf: int) -> None:
        """Remove landmarks that later frames do not find again: seldom found where visible, or seen by no second key frame."""
        lm = self.builder.lm
        ids = self.builder.resolve(self._recent)
        ids = np.unique(ids[ids >= 0])
        age = kf - lm.first_kf[ids]
        is_bad = (lm.n_found[ids] < 0.25 * lm.n_visible[ids]) | ((age >= 2) & (lm.n_obs[ids] < 2))
        self.builder.remove_landmarks(ids[is_bad])
        self._recent = ids[~is_bad & (age < 3)]

    def _share_with_neighbours(self, kf: int, added: np.ndarray) -> None:
        """Look for the new landmarks in the key frames around: a free feature becomes a view, a landmark there is fused."""
        neighbours, shared = self.builder.covisible(kf)
        for other in neighbours[: self.settings.share_key_frames][shared[: self.settings.share_key_frames] >= 15]:
            ids = added[self.builder.lm.is_alive[added]]
            share_landmarks(self.builder, int(other), ids, self.camera, self.sensor, max_distance=self.settings.share_max_distance)

    def _adjust_window(self, kf: int) -> None:
        neighbours, shared = self.builder.covisible(kf)
        window = np.union1d(neighbours[shared >= 15][: self.settings.window_key_frames - 1], self.builder.joined_by_edges(np.array([kf])))
        if len(window) == 0:
            return
        map_adjustment.adjust(
            self.builder,
            np.sort(np.append(window, kf)).astype(np.int32),
            self.camera,
            self.sensor,
            max_iterations=self.settings.window_iterations,
        )


def share_landmarks(builder: MapBuilder, kf: int, ids: np.ndarray, camera: Camera, sensor: SensorConfig, *, max_distance: int) -> int:
    """Look for landmarks `ids` in key frame `kf`: a free feature becomes a view, a landmark already there is fused.

    The feature must lie within 3 sigma of the projection, in depth too. Returns how many were found.
    """
    ids = np.setdiff1d(ids, builder.landmarks_of(kf))
    if len(ids) == 0:
        return 0
    frame = frame_features(builder.features, int(builder.kf.frame[kf]), camera, sensor)
    T_kw = se3.inverse(builder.kf.T_wk[kf])
    feature, _ = guided_matching.search(
        T_kw,
        builder.candidates(ids),
        frame,
        camera,
        octave_scale=builder.octave_scale,
        radius_px=3.0 * sensor.pixel_noise,
        max_distance=max_distance,
        ratio=1.0,
    )
    which = np.flatnonzero(feature >= 0)
    z = se3.transform(T_kw, builder.lm.xyz[ids[which]])[:, 2]
    f = feature[which]
    # 2 % beside the noise: the landmark's own depth was read once, maybe at another distance.
    agrees = ~(np.abs(z - frame.depth[f]) > 3.0 * frame.sigma_z[f] + 0.02 * z)
    which, f = which[agrees], f[agrees]
    there = builder.lm_of_row[frame.first_row + f]
    is_free = there < 0
    builder.observe(kf, ids[which[is_free]], frame.first_row + f[is_free])
    for kept, gone in zip(there[~is_free], ids[which[~is_free]], strict=True):
        if builder.lm.is_alive[kept] and builder.lm.is_alive[gone]:
            builder.fuse(int(kept), int(gone))
    return len(which)
