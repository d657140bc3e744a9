"""Find the poses of frames, one after the other, in a map that is already there."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.estimation import camera_pose
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.schema import LOST, ON_SHAPE, RELOCALISED, TRACKED, Features, Matches, Tracks, Words
from slamcli.slam.depth_tracking import NoReliefs, Placement, Reliefs, Shape
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import MapBuilder
from slamcli.vision import hamming, vocabulary

NO_RELIEFS = NoReliefs()
SEARCH_KEY_FRAMES = 3  # around, that a frame is aligned with when the key frame before it does not do
FEW = 10  # landmarks that help shape; fewer are found anywhere
SEARCH_SECONDS = 2.0  # after so long without a pose, what looks like the shape around the last one may be any place
# [1/m^2, 1/rad^2] what is known of the motion from one frame to the next when it goes on as before: within 10 mm and 0.6 degrees.
STEADY = 1e4 * np.eye(6)


def frame_features(features: Features, frame: int, camera: Camera, sensor: SensorConfig) -> FrameFeatures:
    """Gather the features of one frame with their noise."""
    rows = slice(int(features.offset[frame]), int(features.offset[frame + 1]))
    measured = map_adjustment.measure(features, rows, sensor)
    xy = np.array(features.xy[rows])
    bucket_start, bucket_rows = guided_matching.sort_into_buckets(xy, camera)
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
    return camera_pose.refine_pose(T_cw, x_w, frame.xy[rows], frame.depth[rows], frame.sigma_px[rows], frame.sigma_z[rows], camera)


def word_vector(words: Words, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Give the word vector of one frame: words (B,) and their weights (B,)."""
    span = slice(int(words.bow_offset[frame]), int(words.bow_offset[frame + 1]))
    return np.array(words.bow_word[span]), np.array(words.bow_weight[span])


class Localiser:
    """Finds the pose of one frame after the other: from the frame before it, else by recognising a key frame.

    After `process` of every frame, `tracks()` gives the poses and `lost_reason` says why frames are lost.
    """

    def __init__(
        self,
        builder: MapBuilder,
        map_words: Words,
        features: Features,
        words: Words,
        matches: Matches,
        camera: Camera,
        settings: TrackConfig,
        sensor: SensorConfig,
        rng: np.random.Generator,
        *,
        reliefs: Reliefs = NO_RELIEFS,
        map_reliefs: Reliefs = NO_RELIEFS,
    ):
        """Take the map with the words of its features, and a recording's features, words and matches of neighbouring frames.

        reliefs, map_reliefs : of that recording, and of the one that the map is of; without them, texture alone is followed
        """
        self.builder, self.map_words = builder, map_words
        self.features, self.words, self.matches = features, words, matches
        self.camera, self.settings, self.sensor, self.rng = camera, settings, sensor, rng
        self.octave_scale = float(features.octave_scale)
        self.places = vocabulary.InvertedIndex(len(map_words.idf))
        for kf, frame in enumerate(builder.kf.frame):
            self.places.add(kf, *word_vector(map_words, int(frame)))
        n = len(features.stamp)
        self.ref_kf = np.full(n, -1, dtype=np.int32)
        self.T_kc = np.full((n, 4, 4), np.nan)
        self.state = np.full(n, LOST, dtype=np.uint8)
        self.n_inliers = np.zeros(n, dtype=np.int32)
        self.lost_reason: dict[int, str] = {}
        self.shape = Shape(builder, map_reliefs, reliefs)
        self._latest = self._surely = -1  # frame that has a pose, and frame all of whose pose was measured
        self._placement: Placement | None = None  # of the latest frame, where it rests on shape
        self._pair_of = {(int(i), int(j)): p for p, (i, j) in enumerate(matches.pair)}
        self._previous: FrameFeatures | None = None
        self._lm_of_previous = np.empty(0, dtype=np.int32)  # landmark of each feature of the previous frame, -1 = none

    def process(self, i: int) -> None:
        """Find the pose of frame `i`; frames come in order."""
        frame = frame_features(self.features, i, self.camera, self.sensor)
        self._previous, self._lm_of_previous = frame, self._locate(i, frame)

    def tracks(self) -> Tracks:
        """Give the pose of every frame processed."""
        return Tracks(ref_kf=self.ref_kf, T_kc=self.T_kc, state=self.state, n_inliers=self.n_inliers)

    def pose_of(self, i: int) -> np.ndarray | None:
        """Give T_wc (4, 4) of a frame under the map of now, None if lost."""
        return None if self.ref_kf[i] < 0 else self.builder.kf.T_wk[self.ref_kf[i]] @ self.T_kc[i]

    def segment_of(self, i: int) -> int:
        """Give the map segment that frame `i` has its pose in, -1 if lost."""
        return -1 if self.ref_kf[i] < 0 else int(self.builder.kf.segment[self.ref_kf[i]])

    def _locate(self, i: int, frame: FrameFeatures) -> np.ndarray:
        """Find the pose of frame `i`; returns the landmark of each of its features, none where it is lost."""
        state, found = TRACKED, None
        if len(frame) >= self.settings.min_inliers:
            T_cw, ids = self._initial_pose(i, frame)
            found = self._meet_local_map(frame, T_cw, ids, wanted=self.settings.min_inliers) if T_cw is not None else None
        if found is None or found[0].n_inliers < self.settings.shape_below:
            lm_of = self._locate_on_shape(i, frame, found)
            if lm_of is not None:
                return lm_of
        if found is None and len(frame) >= self.settings.min_inliers:
            T_cw, ids = self._relocalise(i, frame)
            found = self._meet_local_map(frame, T_cw, ids, wanted=self.settings.relocalise_inliers) if T_cw is not None else None
            state = RELOCALISED
        if found is None:
            self.lost_reason.setdefault(i, self._why_lost(frame))
            return np.full(len(frame), -1, dtype=np.int32)
        estimate, lm_of = found
        self._record(i, estimate, lm_of, state)
        return lm_of

    def _why_lost(self, frame: FrameFeatures) -> str:
        if len(frame) < self.settings.min_inliers:
            return f"{len(frame)} features: blank or unreadable image"
        return f"fewer than {self.settings.min_inliers} of {len(frame)} features agree with the map"

    def _record(self, i: int, estimate: PoseEstimate, lm_of: np.ndarray, state: int) -> None:
        kf = int(np.argmax(self.builder.votes(lm_of[lm_of >= 0])))
        self._hang(i, kf, estimate.T_cw, state, estimate.n_inliers)

    def _hang(self, i: int, kf: int, T_cw: np.ndarray, state: int, n_inliers: int) -> None:
        self.ref_kf[i], self.state[i], self.n_inliers[i], self._latest, self._surely = kf, state, n_inliers, i, i
        self.lost_reason.pop(i, None)
        self.T_kc[i] = se3.inverse(T_cw @ self.builder.kf.T_wk[kf])

    def _locate_on_shape(self, i: int, frame: FrameFeatures, found: tuple[PoseEstimate, np.ndarray] | None) -> np.ndarray | None:
        """Align frame `i` with the key frame that the frame before it hangs on, together with what landmarks there are.

        found : the pose that landmarks give, and the landmark of each feature, if they give one
        Returns the landmark of each feature; None where depth shows another place, or not enough to determine the pose.
        """
        self._placement = None
        if self._latest < 0 or self.features.stamp[i] - self.features.stamp[self._latest] > SEARCH_SECONDS:
            return None
        T_wp = self.pose_of(self._latest)
        expected = self._predict(i, T_wp, self._latest, reach=np.inf)
        if found is None:
            placed = self.shape.find(i, self._references(i, expected), [expected, se3.inverse(T_wp)], partial(self._meet_few, frame))
        else:
            placed = self.shape.place(i, int(self.ref_kf[self._latest]), [found[0].T_cw], (found[0].T_cw, found[0].information))
        if placed is None or not placed.is_sound:
            return None
        surely = self._surely if placed.n_determined < 6 else i
        if surely < i:
            self.lost_reason[i] = f"the depth shows {placed.n_determined} of 6 directions only: a flat wall"
            if found is not None or self.features.stamp[i] - self.features.stamp[surely] > self.settings.shape_hold:
                return None
            placed = self.shape.place(i, placed.kf, [expected], (expected, STEADY))
            if not placed.is_sound:
                return None
        few = self._meet_few(frame, placed)
        lm_of = np.full(len(frame), -1, dtype=np.int32) if few is None else few[1]
        self._hang(i, placed.kf, placed.T_cw, ON_SHAPE, int((lm_of >= 0).sum()))
        self._surely, self._placement = surely, placed
        return lm_of

    def _references(self, i: int, T_cw: np.ndarray) -> Iterator[int]:
        """Give the key frames that frame `i`, near T_cw, may be aligned with: that of the latest frame, then those around."""
        kf = int(self.ref_kf[self._latest])
        yield kf
        around = self.shape.around(se3.inverse(T_cw), int(self.builder.kf.segment[kf]))
        yield from around[around != kf][:SEARCH_KEY_FRAMES].tolist()

    def _meet_few(self, frame: FrameFeatures, placed: Placement) -> tuple[PoseEstimate, np.ndarray] | None:
        """Search the frame for the landmarks around the key frame it was aligned with; None where fewer than a few agree, or shape does not."""
        around = self.builder.landmarks_in(np.append(self.builder.joined_by_edges(np.array([placed.kf])), placed.kf))
        if len(around) == 0 or len(frame) < FEW:
            return None
        found = self._meet_local_map(frame, placed.T_cw, around, wanted=FEW)
        return found if found is not None and placed.fits(found[0].T_cw) else None

    def _initial_pose(self, i: int, frame: FrameFeatures) -> tuple[np.ndarray | None, np.ndarray]:
        """Guess from the features matched to the previous frame: where the motion before it does not explain them, by P3P in RANSAC.

        Matches need no motion model, so fast turns do no harm; [Z] 1.2.
        """
        T_wp = self.pose_of(i - 1) if i > 0 else None
        if T_wp is None:
            return None, np.empty(0, np.int32)
        rows, x_w, ids = self._inherit(i, T_wp)
        predicted = self._predict(i, T_wp, i - 1)
        if len(rows) >= self.settings.min_inliers:
            best = estimate_pose(predicted, x_w, frame, rows, self.camera)
            if 2 * best.n_inliers <= len(rows):  # else no other pose can have as many
                start = camera_pose.ransac_p3p(
                    x_w,
                    frame.xy[rows],
                    self.camera,
                    rng=self.rng,
                    rounds=self.settings.ransac_rounds,
                    threshold_px=self.settings.ransac_threshold_px,
                )
                if start is not None:
                    best = max(best, estimate_pose(start.T_cw, x_w, frame, rows, self.camera), key=lambda e: e.n_inliers)
            if best.n_inliers >= self.settings.min_inliers:
                return best.T_cw, self._known(i, ids[best.is_inlier])
        return predicted, self._known(i, self._lm_of_previous)

    def _known(self, i: int, ids: np.ndarray) -> np.ndarray:
        """Give those of `ids` that still are landmarks; where none is, all that the key frame sees on which the frame before `i` hangs."""
        ids = self.builder.resolve(ids)
        ids = ids[ids >= 0]
        return ids if len(ids) else self.builder.landmarks_of(self.ref_kf[i - 1])

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

    def _predict(self, i: int, T_wp: np.ndarray, p: int, *, reach: float = 4.0) -> np.ndarray:
        """Give T_cw of frame `i` under the motion between frame `p`, whose pose is T_wp, and the one before that, scaled by the time.

        reach : times the time between those two, beyond which T_wp itself is given
        """
        T_wq = self.pose_of(p - 1) if p >= 1 else None
        if T_wq is None or self.segment_of(p - 1) != self.segment_of(p):
            return se3.inverse(T_wp)
        stamp = self.features.stamp
        share = (stamp[i] - stamp[p - 1]) / (stamp[p] - stamp[p - 1])
        # A gap in the recording says nothing about the motion within it.
        return se3.inverse(se3.interpolate(T_wq, T_wp, share if share < reach else 1.0))

    def _relocalise(self, i: int, frame: FrameFeatures) -> tuple[np.ndarray | None, np.ndarray]:
        """Recognise a key frame by its words and find the pose in it; [Z] (10)."""
        kfs, scores = self.places.query(*word_vector(self.words, i))
        for kf in kfs[np.argsort(-scores, kind="stable")[: self.settings.relocalise_candidates]]:
            ids = self.builder.lm_of_row[self.builder.rows_of(kf)]
            place = self.builder.rows_of(kf)
            here = slice(frame.first_row, frame.first_row + len(frame))
            match, _ = hamming.match_nodes(
                frame.desc.view(np.uint8),
                self.words.node[here],
                self.builder.features.desc[place],
                self.map_words.node[place],
                frame.angle,
                self.builder.features.angle[place],
            )
            match = match[ids[match[:, 1]] >= 0]
            if len(match) < self.settings.min_inliers:
                continue
            x_w = self.builder.lm.xyz[ids[match[:, 1]]]
            start = camera_pose.ransac_p3p(
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

    def _meet_local_map(
        self, frame: FrameFeatures, T_cw: np.ndarray, ids: np.ndarray, *, wanted: int
    ) -> tuple[PoseEstimate, np.ndarray] | None:
        """Search the frame for all landmarks of the key frames around, and refine; None if fewer than `wanted` agree.

        Associations are made anew from the landmarks' own descriptors: handed on from frame to frame they would creep.
        """
        local = self._local_landmarks(ids)
        candidates = self.builder.candidates(local)
        for radius in (self.settings.search_radius_px, 3.0 * self.settings.search_radius_px):
            feature, is_visible = guided_matching.search(
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
        if len(which) < wanted:
            return None
        estimate = estimate_pose(T_cw, candidates.xyz[which], frame, feature[which], self.camera)
        if estimate.n_inliers < wanted:
            return None
        lm_of = np.full(len(frame), -1, dtype=np.int32)
        agreed = which[estimate.is_inlier]
        lm_of[feature[agreed]] = local[agreed]
        self.builder.lm.n_visible[local[is_visible]] += 1
        self.builder.lm.n_found[local[agreed]] += 1
        return estimate, lm_of

    def _local_landmarks(self, ids: np.ndarray) -> np.ndarray:
        """Give the landmarks of the key frames that see most of `ids`, and of the neighbours of the first of these."""
        votes = self.builder.votes(np.unique(ids))
        order = np.argsort(-votes, kind="stable")
        chosen = order[: min(self.settings.local_key_frames, np.count_nonzero(votes))]
        if len(chosen) == 0:
            return np.empty(0, dtype=np.int32)
        neighbours, _ = self.builder.covisible(int(chosen[0]))
        chosen = np.union1d(chosen, neighbours[: self.settings.local_key_frames // 2])
        return self.builder.landmarks_in(chosen)
