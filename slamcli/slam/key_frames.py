"""The key-frame rule: when a tracked frame joins the map."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.geometry import se3
from slamcli.geometry.algebra import product

# A frame that shows fewer landmarks with depth, and more other features with depth, sees much that is new and near; as ORB-SLAM2 does
# (R. Mur-Artal, J. D. Tardos, IEEE T-RO 2017, doi:10.1109/TRO.2017.2705103, III-F, for 1000 features).
FEW_NEAR_LANDMARKS = 100
MANY_NEAR_FEATURES = 70
MOVED_M, TURNED_RAD = 0.3, 0.26  # from its reference, from where a frame that depth alone holds becomes a key frame
CROWD_M, CROWD_COSINE = 0.1, 0.9945  # key frames nearer than this, and turned by less than 6 degrees, stand in the same place


@dataclass(frozen=True)
class Sighting:
    """What a tracked frame sees, as far as the rule asks; `Tracker._sighting` counts it."""

    n_landmarks: int  # features that show a landmark
    n_near_landmarks: int  # of these, with depth
    n_near_new: int  # features with depth that show no landmark
    n_reference: int  # landmarks of its reference key frame, but for those only one key frame has seen
    frames_since: int  # since the last key frame
    n_crowd: int  # key frames that stand where it does


def wants_key_frame(seen: Sighting, settings: TrackConfig) -> bool:
    """Decide whether a frame that landmarks hold becomes a key frame.

    It does where it meets much new surface; and, unless enough key frames stand there already, where too little of its reference is
    left in view or the last key frame is long ago. Another one in the same place would only make every later frame dearer.
    """
    if seen.n_near_landmarks + seen.n_near_new < settings.min_inliers:
        return False
    meets_new_surface = seen.n_near_landmarks < FEW_NEAR_LANDMARKS and seen.n_near_new > MANY_NEAR_FEATURES
    leaves_reference = seen.n_landmarks < settings.key_frame_share * seen.n_reference
    is_overdue = seen.frames_since >= settings.key_frame_gap
    is_crowded = seen.n_crowd >= settings.key_frame_crowd
    return meets_new_surface or ((leaves_reference or is_overdue) and not is_crowded)


def wants_key_frame_by_depth(T_kc: np.ndarray, overlap: float, settings: TrackConfig) -> bool:
    """Decide whether a frame that depth holds becomes a key frame: it shows too little of its reference, or sees it from elsewhere.

    T_kc : (4, 4) frame to its reference key frame; overlap : share of that key frame's depth that it shows
    """
    motion = se3.log(T_kc)
    has_moved = np.linalg.norm(motion[:3], axis=-1) > MOVED_M or np.linalg.norm(motion[3:], axis=-1) > TURNED_RAD
    return bool(has_moved or overlap < settings.key_frame_share)


def count_crowd(T_wk: np.ndarray, T_wc: np.ndarray) -> int:
    """Count the key frames, of poses (K, 4, 4), that stand and look as a camera at `T_wc` does."""
    is_here = np.linalg.norm(T_wk[:, :3, 3] - T_wc[:3, 3], axis=1) < CROWD_M
    is_here &= product(T_wk[:, :3, 2], T_wc[:3, 2]) > CROWD_COSINE
    return int(np.count_nonzero(is_here))
