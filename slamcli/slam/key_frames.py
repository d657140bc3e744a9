"""The key-frame rule: when a tracked frame joins the map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.geometry import se3
from slamcli.geometry.algebra import product

# A frame that shows fewer landmarks with depth, and more other features with depth, sees much that is new and near; as ORB-SLAM2 does
# (R. Mur-Artal, J. D. Tardos, IEEE T-RO 2017, doi:10.1109/TRO.2017.2705103, III-F, for 1000 features).
FEW_NEAR_LANDMARKS = 100
MANY_NEAR_FEATURES = 70
AWAY_M, AWAY_RAD = 0.3, 0.26  # from its reference, from where a frame that depth alone holds becomes a key frame
CROWD_M, CROWD_COSINE = 0.1, 0.9945  # key frames nearer than this, and turned by less than 6 degrees, stand in the same place
# Reasons for a key frame; "" is none.
NEW_SURFACE, LEAVES_REFERENCE, OVERDUE, HAS_MOVED = "new surface", "leaves reference", "overdue", "has moved"
# Those for which `Tracker` makes one without asking the rule.
BEGINS_SEGMENT, FOR_DEPTH = "begins a segment", "reference for depth"


@dataclass(frozen=True)
class Sighting:
    """What a frame that landmarks hold sees, as far as the rule asks; `Tracker._sighting` counts it."""

    n_landmarks: int  # features that show a landmark
    n_near_landmarks: int  # of these, with depth
    n_near_new: int  # features with depth that show no landmark
    n_reference: int  # landmarks of its reference key frame, but for those only one key frame has seen
    frames_since: int  # since the last key frame
    n_crowd: int  # key frames that stand where it does


@dataclass(frozen=True)
class DepthSighting:
    """How a frame that depth ICP holds sees its reference key frame."""

    T_kc: np.ndarray  # (4, 4) frame to that key frame
    overlap: float  # share of that key frame's depth that it shows
    is_anchored: bool  # whether every direction of its motion was measured


def by_landmarks(seen: Sighting, settings: TrackConfig) -> str:
    """Give the reason for which a frame that landmarks hold becomes a key frame, "" where it does not.

    It does where it meets much new surface; and, unless enough key frames stand there already, where too little of its reference is
    left in view or the last key frame is long ago. Another one in the same place would only make every later frame dearer.
    """
    if seen.n_near_landmarks + seen.n_near_new < settings.min_inliers:
        return ""  # too little to make landmarks of
    meets_new_surface = seen.n_near_landmarks < FEW_NEAR_LANDMARKS and seen.n_near_new > MANY_NEAR_FEATURES
    leaves_reference = seen.n_landmarks < settings.key_frame_share * seen.n_reference
    is_overdue = seen.frames_since >= settings.key_frame_gap
    is_crowded = seen.n_crowd >= settings.key_frame_crowd
    if meets_new_surface:
        return NEW_SURFACE
    if is_crowded:
        return ""
    return LEAVES_REFERENCE if leaves_reference else OVERDUE if is_overdue else ""


def by_depth(seen: DepthSighting, settings: TrackConfig) -> str:
    """Give the reason for which a frame that depth holds becomes a key frame, "" where it does not.

    It does where it shows too little of its reference, or sees it from elsewhere; unless the frames before it lent its pose a direction:
    what rests on it would share their error.
    """
    if not seen.is_anchored:
        return ""
    if seen.overlap < settings.key_frame_share:
        return LEAVES_REFERENCE
    motion = se3.log(seen.T_kc)
    has_moved = np.linalg.norm(motion[:3], axis=-1) > AWAY_M or np.linalg.norm(motion[3:], axis=-1) > AWAY_RAD
    return HAS_MOVED if has_moved else ""


@dataclass(frozen=True)
class KeyFrameRule:
    """When a located frame becomes a key frame: functions that return the reason, "" where it does not."""

    by_landmarks: Callable[[Sighting, TrackConfig], str] = by_landmarks  # of a frame that landmarks hold
    by_depth: Callable[[DepthSighting, TrackConfig], str] = by_depth  # of one that depth ICP holds


DEFAULT_RULE = KeyFrameRule()


def count_crowd(T_wk: np.ndarray, T_wc: np.ndarray) -> int:
    """Count the key frames, of poses (K, 4, 4), that stand and look as a camera at `T_wc` does."""
    is_here = np.linalg.norm(T_wk[:, :3, 3] - T_wc[:3, 3], axis=1) < CROWD_M
    is_here &= product(T_wk[:, :3, 2], T_wc[:3, 2]) > CROWD_COSINE
    return int(np.count_nonzero(is_here))
