"""Build a map from one frame after the other: locate the frame, decide on a key frame, begin a new segment where tracking is lost for good."""

from collections import Counter

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.schema import KEY_FRAME, ON_DEPTH, TRACKED, Map, Tracks
from slamcli.slam import background_prior, key_frames, rests
from slamcli.slam.frame_poses import Location
from slamcli.slam.key_frames import DEFAULT_RULE, DepthSighting, KeyFrameRule, Sighting
from slamcli.slam.localizer import KnownMap, Localizer, nothing_seen
from slamcli.slam.map_growth import MapGrowth
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.slam.recording import NOTHING_KNOWN, KnownMotion, TrackingInput
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import SparseMap


class Tracker:
    """Builds the map that it finds the frames in; `map()` and `tracks()` return both.

    Where a frame is lost and not recognized for a while, a new segment of the map begins, with a world frame of its own. Segments are
    joined later, by places that both saw.
    """

    def __init__(
        self,
        recording: TrackingInput,
        settings: TrackConfig,
        rng: np.random.Generator,
        *,
        motion: KnownMotion = NOTHING_KNOWN,
        rule: KeyFrameRule = DEFAULT_RULE,
    ) -> None:
        """Begin without a map; motion : what is known of the camera's motion beforehand; rule : when a frame becomes a key frame."""
        self._frames, self._settings, self._background, self._rule = recording.frames, settings, motion.background, rule
        self.key_frame_reasons: Counter[str] = Counter()  # how often each made a key frame
        self._is_still = rests.within(motion.stands_still, len(recording.frames), with_last=False)
        self._stays = rests.within(motion.stands_still, len(recording.frames), with_last=True)
        self._sparse_map = SparseMap(recording.frames.features)
        self._places = PlaceIndex(recording.words, self._sparse_map.kf.frame)
        known = KnownMap(self._sparse_map, self._places, recording.points)
        self._localizer = Localizer(
            known, recording, settings, rng, background=motion.background, make_reference=self._add_previous_as_key_frame
        )
        self._poses, self._previous = self._localizer.poses, self._localizer.previous
        self._growth = MapGrowth(self._sparse_map, recording.frames, settings)
        self._segment = -1  # that frames are added to; -1 before the first
        self._n_lost = 0  # frames in a row that saw enough and were not recognized
        self._first_lost = -1  # of these

    def process(self, i: int) -> None:
        """Register frame `i`: locate it in the map, and make it a key frame where the rule asks for one. Frames come in order.

        Locating by depth may make the frame before it a key frame, see `DepthLocalizer`.
        """
        frame = self._frames[i]
        if self._segment < 0:
            landmark = self._start_segment(i, frame)
        elif self._is_still[i] and self._poses.has_pose(i - 1):
            self._poses.stay(i)
            landmark = nothing_seen(frame)
        elif (location := self._localizer.locate(i, frame)) is None:
            landmark = self._lose(i, frame)
        else:
            self._poses.attach(i, location)
            self._segment, self._n_lost = self._poses.segment(i), 0
            landmark = self._grow(i, frame, location)
        self._previous.remember(frame, landmark)

    def map(self) -> Map:
        """Return the map built so far."""
        return self._sparse_map.snapshot()

    def forget(self, rows: np.ndarray) -> None:
        """Remove the observations of features `rows` (N,) from the map; the poses stay as they are."""
        self._sparse_map.remove_observations(rows)

    def tracks(self) -> Tracks:
        """Return the pose of every frame processed."""
        return self._poses.tracks()

    @property
    def lost_reason(self) -> dict[int, str]:
        """Say of each lost frame why it is lost."""
        return self._poses.lost_reason

    def _grow(self, i: int, frame: FrameFeatures, location: Location) -> np.ndarray:
        """Make frame `i`, which has its pose, a key frame where the rule asks for one; returns the landmarks of its features after that."""
        if self._stays[i] and self._poses.has_pose(i - 1):
            self._poses.stay(i)  # the last of a rest, located for the landmarks that the next frame is tracked by
            return location.landmark
        reason = self._reason_for_key_frame(i, frame, location)
        if not reason:
            return location.landmark
        self.key_frame_reasons[reason] += 1
        return self._add_key_frame(i, frame, self._poses.T_wc(i), location.landmark)

    def _reason_for_key_frame(self, i: int, frame: FrameFeatures, location: Location) -> str:
        if location.overlap is not None:
            return self._rule.by_depth(DepthSighting(self._poses.T_kc[i], location.overlap, location.is_anchored), self._settings)
        return self._rule.by_landmarks(self._sighting(i, frame, location.landmark), self._settings)

    def _sighting(self, i: int, frame: FrameFeatures, landmark: np.ndarray) -> Sighting:
        """Count what frame `i` sees, for the key-frame rule."""
        T_wc = self._poses.T_wc(i)
        kf, lm = self._sparse_map.kf, self._sparse_map.lm
        is_near, is_known, is_here = np.isfinite(frame.depth), landmark >= 0, kf.segment == self._segment
        seen = self._sparse_map.landmarks_of(int(self._poses.ref_kf[i]))
        least = min(2, np.count_nonzero(is_here))
        return Sighting(
            n_landmarks=int(np.count_nonzero(is_known)),
            n_near_landmarks=int(np.count_nonzero(is_known & is_near)),
            n_near_new=int(np.count_nonzero(~is_known & is_near)),
            n_reference=int(np.count_nonzero(lm.n_obs[seen] >= least)),
            frames_since=i - int(kf.frame[-1]),
            n_crowd=key_frames.count_crowd(kf.T_wk[is_here], T_wc),
        )

    def _add_key_frame(self, i: int, frame: FrameFeatures, T_wc: np.ndarray, landmark: np.ndarray) -> np.ndarray:
        """Make frame `i` a key frame that stands at `T_wc`; returns the landmarks of its features after that."""
        kf, added = self._growth.insert(i, frame, T_wc, landmark, self._segment)
        self._places.add(i)
        known = landmark[landmark >= 0]
        # Landmarks enough to recognize a place by hold the key frame; depth alone might slide along a corridor.
        if self._poses.state[i] == ON_DEPTH and len(known) < self._settings.relocalize_inliers:
            self._localizer.aligner.add_edges(kf)
        if self._background is not None and len(known) < background_prior.ENOUGH:
            self._join_by_background(kf, self._background)
        self._poses.make_key_frame(i, kf)
        self._growth.cull_share_adjust(kf, added, known)
        return self._sparse_map.resolve(self._sparse_map.lm_of_row[self._sparse_map.rows_of(kf)])

    def _join_by_background(self, kf: int, T_wb: np.ndarray) -> None:
        """Add an edge from a key frame to the one before it in its segment, as far apart as the background's motion says."""
        frame, segment = self._sparse_map.kf.frame, self._sparse_map.kf.segment
        before = np.flatnonzero(segment[:kf] == segment[kf])
        if len(before):
            other = int(before[-1])
            T_ij = product(se3.inverse(T_wb[frame[kf]]), T_wb[frame[other]])
            self._sparse_map.add_edge(kf, other, T_ij, background_prior.BETWEEN_KEY_FRAMES)

    def _add_previous_as_key_frame(self, i: int) -> int | None:
        """Make the frame before `i` a key frame that depth can be aligned with; None where its own pose is not fully measured."""
        previous = self._previous.features
        if previous is None or self._poses.anchored != i - 1 or self._poses.state[i - 1] not in (TRACKED, ON_DEPTH):
            return None
        self.key_frame_reasons[key_frames.FOR_DEPTH] += 1
        self._previous.remember(previous, self._add_key_frame(i - 1, previous, self._poses.T_wc(i - 1), self._previous.landmark))
        return int(self._poses.ref_kf[i - 1])

    # -- segments -----------------------------------------------------------------------------------------------------------------

    def _start_segment(self, i: int, frame: FrameFeatures) -> np.ndarray:
        """Make frame `i` the first key frame of a new segment if it sees enough with depth; returns the landmarks of its features."""
        n_depth = int(np.isfinite(frame.depth).sum())
        if n_depth < self._settings.start_features and not self._localizer.aligner.fixes_all(i):
            if self._segment < 0:
                seen = f"{len(frame)} features, {n_depth} with depth, {self._settings.start_features} wanted"
                self.lost_reason[i] = f"no map yet: {seen}, and depth shows too little shape to begin with"
            return nothing_seen(frame)
        self._segment, self._n_lost = len(np.unique(self._sparse_map.kf.segment)), 0
        self.lost_reason.pop(i, None)
        self.key_frame_reasons[key_frames.BEGINS_SEGMENT] += 1
        return self._add_key_frame(i, frame, np.eye(4), nothing_seen(frame))

    def _lose(self, i: int, frame: FrameFeatures) -> np.ndarray:
        """Count a lost frame; after too many that could have been recognized, begin a new segment. Returns the landmarks of its features."""
        if len(frame) >= self._settings.min_inliers or self._localizer.aligner.fixes_all(i):
            self._first_lost = i if self._n_lost == 0 else self._first_lost
            self._n_lost += 1
        if 0 < self._settings.segment_after <= self._n_lost:
            return self._begin_again(i)
        return nothing_seen(frame)

    def _begin_again(self, last: int) -> np.ndarray:
        """Begin a new segment with the first lost frame, nearest to what was seen before, and track those after it up to `last` anew."""
        for i in range(self._first_lost, last + 1):
            frame = self._frames[i]
            self._previous.remember(frame, self._start_segment(i, frame))
            if self._poses.state[i] == KEY_FRAME:
                break
        for later in range(i + 1, last + 1):
            self.process(later)
        return self._previous.landmark
