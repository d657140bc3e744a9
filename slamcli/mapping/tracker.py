"""The per-frame state machine: inherit landmarks, find the pose, meet the local map, decide on a key frame."""

import numpy as np

from slamcli.config import SensorConfig, TrackConfig
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.mapping import adjustment, pose, projection
from slamcli.mapping.mapbuilder import MapBuilder
from slamcli.mapping.pose import PoseEstimate
from slamcli.mapping.projection import FrameFeatures
from slamcli.schema import KEY_FRAME, LOST, RELOCALISED, TRACKED, Features, Map, Matches, Tracks, Words
from slamcli.vision import hamming, vocabulary


def frame_features(features: Features, frame: int, camera: Camera, sensor: SensorConfig) -> FrameFeatures:
    """Gather the features of one frame with their noise."""
    rows = slice(int(features.offset[frame]), int(features.offset[frame + 1]))
    measured = adjustment.measure(features, rows, sensor)
    xy = np.array(features.xy[rows])
    bucket_start, bucket_rows = projection.sort_into_buckets(xy, camera)
    return FrameFeatures(
        xy=xy,
        depth=measured.depth,
        octave=np.array(features.octave[rows]),
        angle=np.array(features.angle[rows]),
        desc=np.array(features.desc[rows]).view(np.uint64),
        sigma_px=measured.sigma_px,
        sigma_z=measured.sigma_z,
        first_row=rows.start,
        bucket_start=bucket_start,
        bucket_rows=bucket_rows,
    )


def estimate_pose(T_cw: np.ndarray, x_w: np.ndarray, frame: FrameFeatures, rows: np.ndarray, camera: Camera) -> PoseEstimate:
    """Refine a pose on landmarks `x_w` (N, 3) seen as features `rows` (N,) of the frame."""
    return pose.refine_pose(T_cw, x_w, frame.xy[rows], frame.depth[rows], frame.sigma_px[rows], frame.sigma_z[rows], camera)


class Tracker:
    """Builds a map from one frame after the other.

    After `process` of every frame, `tracks()` and `map()` give the result and `lost_reason` says why frames are lost.
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
    ):
        self.features, self.words, self.matches = features, words, matches
        self.camera, self.settings, self.sensor, self.rng = camera, settings, sensor, rng
        self.builder = MapBuilder(features)
        self.octave_scale = float(features.octave_scale)
        self.places = vocabulary.InvertedIndex(len(words.idf))
        n = len(features.stamp)
        self.ref_kf = np.full(n, -1, dtype=np.int32)
        self.T_kc = np.full((n, 4, 4), np.nan)
        self.state = np.full(n, LOST, dtype=np.uint8)
        self.n_inliers = np.zeros(n, dtype=np.int32)
        self.lost_reason: dict[int, str] = {}
        self._pair_of = {(int(i), int(j)): p for p, (i, j) in enumerate(matches.pair)}
        self._previous: FrameFeatures | None = None
        self._lm_of_previous = np.empty(0, dtype=np.int32)  # landmark of each feature of the previous frame, -1 = none
        self._recent = np.empty(0, dtype=np.int32)  # landmarks still on probation

    def process(self, i: int) -> None:
        """Track frame `i`; frames come in order."""
        frame = frame_features(self.features, i, self.camera, self.sensor)
        if len(self.builder.kf) == 0:
            lm_of = self._start(i, frame)
        else:
            lm_of = self._track(i, frame)
        self._previous, self._lm_of_previous = frame, lm_of

    def tracks(self) -> Tracks:
        """Give the pose of every frame processed."""
        return Tracks(ref_kf=self.ref_kf, T_kc=self.T_kc, state=self.state, n_inliers=self.n_inliers)

    def map(self) -> Map:
        """Give the map built so far."""
        return self.builder.snapshot()

    def _start(self, i: int, frame: FrameFeatures) -> np.ndarray:
        has_depth = np.isfinite(frame.depth)
        if has_depth.sum() < self.settings.start_features:
            self.lost_reason[i] = (
                f"no map yet: {len(frame)} features, {int(has_depth.sum())} with depth, {self.settings.start_features} wanted"
            )
            return np.full(len(frame), -1, dtype=np.int32)
        return self._add_key_frame(i, frame, np.eye(4), np.full(len(frame), -1, dtype=np.int32))

    def _track(self, i: int, frame: FrameFeatures) -> np.ndarray:
        """Find the pose of frame `i`; returns the landmark of each of its features."""
        nothing = np.full(len(frame), -1, dtype=np.int32)
        if len(frame) < self.settings.min_inliers:
            self.lost_reason[i] = f"{len(frame)} features: blank or unreadable image"
            return nothing
        state = TRACKED
        T_cw, ids = self._initial_pose(i, frame)
        found = self._meet_local_map(frame, T_cw, ids) if T_cw is not None else None
        if found is None:
            T_cw, ids = self._relocalise(i, frame)
            found = self._meet_local_map(frame, T_cw, ids) if T_cw is not None else None
            state = RELOCALISED
        if found is None:
            self.lost_reason[i] = f"fewer than {self.settings.min_inliers} of {len(frame)} features agree with the map"
            return nothing
        estimate, lm_of = found
        self._record(i, estimate, lm_of, state)
        if self._wants_key_frame(i, frame, lm_of):
            lm_of = self._add_key_frame(i, frame, se3.inverse(estimate.T_cw), lm_of)
        return lm_of

    def _record(self, i: int, estimate: PoseEstimate, lm_of: np.ndarray, state: int) -> None:
        kf = int(np.argmax(self.builder.votes(lm_of[lm_of >= 0])))
        self.ref_kf[i], self.state[i], self.n_inliers[i] = kf, state, estimate.n_inliers
        self.T_kc[i] = se3.inverse(estimate.T_cw @ self.builder.kf.T_wk[kf])

    def pose_of(self, i: int) -> np.ndarray | None:
        """Give T_wc (4, 4) of a frame under the map of now, None if lost."""
        return None if self.ref_kf[i] < 0 else self.builder.kf.T_wk[self.ref_kf[i]] @ self.T_kc[i]

    # -- the first guess ----------------------------------------------------------------------------------------------------------

    def _initial_pose(self, i: int, frame: FrameFeatures) -> tuple[np.ndarray | None, np.ndarray]:
        """Guess from the features matched to the previous frame, by P3P in RANSAC; else from the motion before it.

        Matches need no motion model, so fast turns do no harm; [Z] 1.2.
        """
        T_wp = self.pose_of(i - 1)
        if T_wp is None:
            return None, np.empty(0, np.int32)
        rows, x_w, ids = self._inherit(i, T_wp)
        guesses = [self._predict(i, T_wp)]
        if len(rows) >= self.settings.min_inliers:
            start = pose.ransac_p3p(
                x_w,
                frame.xy[rows],
                self.camera,
                rng=self.rng,
                rounds=self.settings.ransac_rounds,
                threshold_px=self.settings.ransac_threshold_px,
            )
            if start is not None:
                guesses.append(start.T_cw)
            estimates = [estimate_pose(T_cw, x_w, frame, rows, self.camera) for T_cw in guesses]
            best = max(estimates, key=lambda e: e.n_inliers)
            if best.n_inliers >= self.settings.min_inliers:
                return best.T_cw, ids[(ids >= 0) & best.is_inlier]
        return guesses[0], self._lm_of_previous[self._lm_of_previous >= 0]

    def _inherit(self, i: int, T_wp: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Give features of frame `i` that match the previous frame: rows, points [m, world], landmark ids (-1: lifted by depth alone)."""
        pair = self._pair_of.get((i, i - 1))
        if pair is None:
            return np.empty(0, np.int32), np.empty((0, 3)), np.empty(0, np.int32)
        match = self.matches.row[self.matches.offset[pair] : self.matches.offset[pair + 1]]
        previous = self._previous
        ids = self.builder.resolve(self._lm_of_previous[match[:, 1]])
        x_w = se3.transform(T_wp, self.camera.backproject(previous.xy[match[:, 1]], previous.depth[match[:, 1]]))
        x_w[ids >= 0] = self.builder.lm.xyz[ids[ids >= 0]]
        is_usable = np.isfinite(x_w[:, 0])
        return match[is_usable, 0], x_w[is_usable], ids[is_usable]

    def _predict(self, i: int, T_wp: np.ndarray) -> np.ndarray:
        """Give T_cw of frame `i` under the motion between the two frames before it, scaled by the time between."""
        T_wq = self.pose_of(i - 2) if i >= 2 else None
        if T_wq is None:
            return se3.inverse(T_wp)
        stamp = self.features.stamp
        share = (stamp[i] - stamp[i - 2]) / (stamp[i - 1] - stamp[i - 2])
        # A gap in the recording says nothing about the motion within it.
        return se3.inverse(se3.interpolate(T_wq, T_wp, share if share < 4.0 else 1.0))

    def _relocalise(self, i: int, frame: FrameFeatures) -> tuple[np.ndarray | None, np.ndarray]:
        """Recognise a key frame by its words and find the pose in it; [Z] (10)."""
        span = slice(int(self.words.bow_offset[i]), int(self.words.bow_offset[i + 1]))
        kfs, scores = self.places.query(np.array(self.words.bow_word[span]), np.array(self.words.bow_weight[span]))
        for kf in kfs[np.argsort(-scores, kind="stable")[: self.settings.relocalise_candidates]]:
            ids = self.builder.lm_of_row[self.builder.rows_of(kf)]
            place = self.builder.rows_of(kf)
            here = slice(frame.first_row, frame.first_row + len(frame))
            match, _ = hamming.match_nodes(
                frame.desc.view(np.uint8),
                self.words.node[here],
                self.features.desc[place],
                self.words.node[place],
                frame.angle,
                self.features.angle[place],
            )
            match = match[ids[match[:, 1]] >= 0]
            if len(match) < self.settings.min_inliers:
                continue
            x_w = self.builder.lm.xyz[ids[match[:, 1]]]
            start = pose.ransac_p3p(
                x_w,
                frame.xy[match[:, 0]],
                self.camera,
                rng=self.rng,
                rounds=3 * self.settings.ransac_rounds,
                threshold_px=self.settings.ransac_threshold_px,
            )
            if start is None:
                continue
            estimate = estimate_pose(start.T_cw, x_w, frame, match[:, 0], self.camera)
            if estimate.n_inliers >= self.settings.min_inliers:
                return estimate.T_cw, ids[match[estimate.is_inlier, 1]]
        return None, np.empty(0, np.int32)

    # -- the local map ------------------------------------------------------------------------------------------------------------

    def _meet_local_map(self, frame: FrameFeatures, T_cw: np.ndarray, ids: np.ndarray) -> tuple[PoseEstimate, np.ndarray] | None:
        """Search the frame for all landmarks of the key frames around, and refine; None if too few are found.

        Associations are made anew from the landmarks' own descriptors: handed on from frame to frame they would creep.
        """
        local = self._local_landmarks(ids)
        candidates = self.builder.candidates(local)
        for radius in (self.settings.search_radius_px, 3.0 * self.settings.search_radius_px):
            feature, is_visible = projection.search(
                T_cw,
                candidates,
                frame,
                self.camera,
                octave_scale=self.octave_scale,
                radius_px=radius,
                max_distance=self.settings.search_max_distance,
                ratio=self.settings.search_ratio,
            )
            which = np.flatnonzero(feature >= 0)
            if len(which) >= 2 * self.settings.min_inliers:
                break
        if len(which) < self.settings.min_inliers:
            return None
        estimate = estimate_pose(T_cw, candidates.xyz[which], frame, feature[which], self.camera)
        if estimate.n_inliers < self.settings.min_inliers:
            return None
        lm_of = np.full(len(frame), -1, dtype=np.int32)
        agreed = which[estimate.is_inlier]
        lm_of[feature[agreed]] = local[agreed]
        self.builder.lm.n_visible[local[is_visible]] += 1
        self.builder.lm.n_found[local[agreed]] += 1
        return estimate, lm_of

    def _local_landmarks(self, ids: np.ndarray) -> np.ndarray:
        """Give the landmarks of the key frames that see most of `ids`, and of the neighbours of the first of these."""
        votes = self.builder.votes(self.builder.resolve(np.unique(ids)) if len(ids) else ids)
        order = np.argsort(-votes, kind="stable")
        chosen = order[: min(self.settings.local_key_frames, np.count_nonzero(votes))]
        if len(chosen) == 0:
            chosen = np.arange(max(0, len(self.builder.kf) - self.settings.local_key_frames), len(self.builder.kf))
        else:
            neighbours, _ = self.builder.covisible(int(chosen[0]))
            chosen = np.union1d(chosen, neighbours[: self.settings.local_key_frames // 2])
        return self.builder.landmarks_in(chosen)

    # -- key frames ---------------------------------------------------------------------------------------------------------------

    def _wants_key_frame(self, i: int, frame: FrameFeatures, lm_of: np.ndarray) -> bool:
        """Decide as ORB-SLAM2 does: too little of the reference key frame is left in view, or much new surface is near."""
        has_depth = np.isfinite(frame.depth)
        if has_depth.sum() < self.settings.min_inliers:
            return False
        kf = self.ref_kf[i]
        tracked = lm_of >= 0
        seen = self.builder.landmarks_of(kf)
        n_reference = np.count_nonzero(self.builder.lm.n_obs[seen] >= min(2, len(self.builder.kf)))
        leaves_reference = tracked.sum() < self.settings.key_frame_share * n_reference
        meets_new_surface = (tracked & has_depth).sum() < 100 and (~tracked & has_depth).sum() > 70
        is_overdue = i - self.builder.kf.frame[-1] >= self.settings.key_frame_gap
        return bool(leaves_reference or meets_new_surface or is_overdue)

    def _add_key_frame(self, i: int, frame: FrameFeatures, T_wc: np.ndarray, lm_of: np.ndarray) -> np.ndarray:
        """Make frame `i` a key frame, grow the map by what it sees, and adjust the window around it."""
        builder = self.builder
        kf = builder.add_key_frame(i, T_wc)
        known = np.flatnonzero(lm_of >= 0)
        builder.observe(kf, lm_of[known], frame.first_row + known)
        new = np.flatnonzero((lm_of < 0) & np.isfinite(frame.depth))
        x_w = se3.transform(T_wc, self.camera.backproject(frame.xy[new], frame.depth[new]))
        added = builder.add_landmarks(kf, frame.first_row + new, x_w)
        span = slice(int(self.words.bow_offset[i]), int(self.words.bow_offset[i + 1]))
        self.places.add(kf, np.array(self.words.bow_word[span]), np.array(self.words.bow_weight[span]))
        self.ref_kf[i], self.T_kc[i], self.state[i] = kf, np.eye(4), KEY_FRAME
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
        window = neighbours[shared >= 15][: self.settings.window_key_frames - 1]
        if len(window) == 0:
            return
        adjustment.adjust(
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
    feature, _ = projection.search(
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
