"""Find the poses of frames in a map: predict, match, estimate, refine on the local map; else depth ICP, else relocalization; [Z] 1.2."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.schema import ON_DEPTH, RELOCALIZED, TRACKED, Tracks
from slamcli.slam import background_prior, initial_pose
from slamcli.slam.depth_localization import DepthLocalizer, DepthMatch
from slamcli.slam.depth_tracking import NO_FRAME_POINTS, DepthAligner, FramePoints
from slamcli.slam.frame_poses import FramePoses, Location
from slamcli.slam.initial_pose import PreviousFrame
from slamcli.slam.local_map import LocalMap, MapMatch
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.slam.recording import TrackingInput
from slamcli.slam.relocalization import Relocalizer
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import SparseMap


def no_reference(i: int) -> None:
    """Offer no further key frame: the map is not to grow."""


@dataclass(frozen=True)
class KnownMap:
    """The map that frames are looked for in."""

    sparse_map: SparseMap
    places: PlaceIndex  # of its key frames
    points: FramePoints = NO_FRAME_POINTS  # of the recording that it is of


class Localizer:
    """Finds the pose of one frame after the other: from the frame before it, else by depth, else by recognizing a key frame.

    `poses` holds what was found, and why frames are lost.
    """

    def __init__(
        self,
        known: KnownMap,
        recording: TrackingInput,
        settings: TrackConfig,
        rng: np.random.Generator,
        *,
        background: np.ndarray | None = None,
        make_reference: Callable[[int], int | None] = no_reference,
    ) -> None:
        """Take the map, and the recording whose frames are found in it, which may be another than the map is of.

        background : see KnownMotion; make_reference : see DepthLocalizer
        """
        sparse_map = known.sparse_map
        self._sparse_map, self._frames, self._settings, self._rng = sparse_map, recording.frames, settings, rng
        self.poses = FramePoses(sparse_map, recording.stamp, background)
        self.previous = PreviousFrame(sparse_map, recording.matches)
        self.aligner = DepthAligner(sparse_map, known.points, recording.points)
        self._local_map = LocalMap(sparse_map, settings)
        self._depth_localizer = DepthLocalizer(
            sparse_map, self.poses, self.aligner, self._local_map, settings, make_reference=make_reference
        )
        self._relocalizer = Relocalizer(sparse_map, known.places, recording.words, settings, rng)

    def process(self, i: int) -> None:
        """Find the pose of frame `i`; frames come in order."""
        frame = self._frames[i]
        location = self.locate(i, frame)
        if location is not None:
            self.poses.attach(i, location)
        self.previous.remember(frame, nothing_seen(frame) if location is None else location.landmark)

    def tracks(self) -> Tracks:
        """Return the pose of every frame processed."""
        return self.poses.tracks()

    def locate(self, i: int, frame: FrameFeatures) -> Location | None:
        """Find where frame `i` is, for the caller to attach; None where it is lost, and `poses.lost_reason` says why.

        By the landmarks that the frame before it saw; by depth ICP where these are few; by a key frame that looks alike where both fail;
        by the background's motion, where that is known and nothing else holds the frame. Depth may ask for a further key frame on the way,
        see `DepthLocalizer`.
        """
        found = self._follow(i, frame)
        if found is not None and self.poses.has_background:
            found = self._reconcile(i, found)
        if found is None or found.estimate.n_inliers < self._settings.depth_icp_below:
            aligned = self._depth_localizer.locate(i, frame, found)
            if aligned is not None:
                return _by_depth(aligned)
        if found is not None:
            return self._by_landmarks(found, TRACKED)
        found = self._relocalize(i, frame)
        if found is not None:
            return self._by_landmarks(found, RELOCALIZED)
        if self.poses.has_background and self.poses.has_pose(i - 1):
            return self._by_background(i, frame)
        self.poses.lost_reason.setdefault(i, self._why_lost(frame))
        return None

    def _follow(self, i: int, frame: FrameFeatures) -> MapMatch | None:
        """Track frame `i` from the one before it: predict, match, estimate, refine on the local map; None if that one is lost or too little agrees."""
        if self._sees_too_little(frame) or not self.poses.has_pose(i - 1):
            return None
        predicted = self.poses.predict(i, i - 1)
        pairs = self.previous.correspondences(i, self.poses.T_wc(i - 1))
        estimate = initial_pose.estimate(pairs, predicted, frame, self._settings, self._rng)
        if estimate is None:
            start, seeds = predicted, self.previous.landmark
        else:
            start, seeds = estimate.T_cw, pairs.landmark[estimate.is_inlier]
        return self._local_map.match(frame, start, self._still_known(i, seeds), wanted=self._settings.min_inliers)

    def _reconcile(self, i: int, found: MapMatch) -> MapMatch | None:
        """Weigh the pose of frame `i` against the background's motion; None where it contradicts that."""
        for p in (i - 1, self.poses.before(i, background_prior.LOOK_BACK)):
            if background_prior.contradicts(found, self.poses.predict(i, p), self.poses.T_wc(p)):
                return None
        return background_prior.drawn(found, self.poses.predict(i, i - 1))

    def _still_known(self, i: int, ids: np.ndarray) -> np.ndarray:
        """List those of `ids` that still are landmarks; where none is, all of the reference key frame of the frame before `i`."""
        ids = self._sparse_map.resolve(ids)
        ids = ids[ids >= 0]
        return ids if len(ids) else self._sparse_map.landmarks_of(int(self.poses.ref_kf[i - 1]))

    def _by_background(self, i: int, frame: FrameFeatures) -> Location:
        """Place frame `i` where the background's motion takes the frame before it: no landmark holds it."""
        kf, T_cw = int(self.poses.ref_kf[i - 1]), self.poses.predict(i, i - 1)
        return Location(T_cw, kf, TRACKED, nothing_seen(frame), n_inliers=0, is_anchored=False)

    def _relocalize(self, i: int, frame: FrameFeatures) -> MapMatch | None:
        """Find frame `i` by a key frame that looks alike, wherever it is; None where none does."""
        place = None if self._sees_too_little(frame) else self._relocalizer.find(i, frame)
        return None if place is None else self._local_map.match(frame, *place, wanted=self._settings.relocalize_inliers)

    def _by_landmarks(self, found: MapMatch, state: int) -> Location:
        """Place a frame relative to the key frame that shares the most of its landmarks."""
        kf = int(np.argmax(self._sparse_map.votes(found.landmark[found.landmark >= 0])))
        return Location(found.estimate.T_cw, kf, state, found.landmark, found.estimate.n_inliers)

    def _sees_too_little(self, frame: FrameFeatures) -> bool:
        return len(frame) < self._settings.min_inliers

    def _why_lost(self, frame: FrameFeatures) -> str:
        if self._sees_too_little(frame):
            return f"{len(frame)} features: blank or unreadable image"
        return f"fewer than {self._settings.min_inliers} of {len(frame)} features agree with the map"


def _by_depth(found: DepthMatch) -> Location:
    """Place a frame relative to the key frame that its depth image was aligned with."""
    at, n_inliers = found.placement, int(np.count_nonzero(found.landmark >= 0))
    return Location(at.T_cw, at.kf, ON_DEPTH, found.landmark, n_inliers, is_anchored=found.is_anchored, overlap=at.alignment.overlap)


def nothing_seen(frame: FrameFeatures) -> np.ndarray:
    """Return the landmarks of a frame's features where none is known."""
    return np.full(len(frame), -1, dtype=np.int32)
