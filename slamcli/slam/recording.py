"""What tracking takes of a recording: its frames as the stages before left them, what is known of the camera's motion, and a recording once tracked."""

from dataclasses import dataclass

import numpy as np

from slamcli.schema import Matches, Rests, Tracks, Words
from slamcli.slam import rests
from slamcli.slam.depth_tracking import NO_FRAME_POINTS, FramePoints
from slamcli.sparse_map.frame import FrameStore


@dataclass(frozen=True)
class TrackingInput:
    """The frames of a recording: features, words, matches with the frame before, and the oriented points of the depth images."""

    frames: FrameStore
    words: Words
    matches: Matches
    points: FramePoints = NO_FRAME_POINTS  # without them, texture alone is followed

    @property
    def stamp(self) -> np.ndarray:
        """Return the time (F,) of each frame [s]."""
        return self.frames.features.stamp


@dataclass(frozen=True)
class KnownMotion:
    """What is known of the camera's motion before it is tracked."""

    # (F, 4, 4) T_wc against what stands still, which drift, but whose motion from frame to frame is right: it predicts, and joins key frames.
    background: np.ndarray | None = None
    stands_still: Rests = rests.NONE  # frames of a rest stay where its first one is, and none of them is a key frame


NOTHING_KNOWN = KnownMotion()


@dataclass(frozen=True)
class TrackedRecording:
    """The frames of a recording, where they stand in a map, and when the camera stood still."""

    frames: FrameStore
    tracks: Tracks
    stands_still: Rests = rests.NONE  # the frames of a rest have one pose
