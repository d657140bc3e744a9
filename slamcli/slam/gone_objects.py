"""What stood in an earlier recording and is gone in a later one: surfaces that key frames of later recordings look through."""

from collections.abc import Callable, Iterable

import numpy as np

from slamcli.slam import depth_views
from slamcli.slam import moving_object_kernels as kernels
from slamcli.slam.depth_views import Views
from slamcli.slam.moving_objects import FOR_MAPS, GROUP_JUMP, MOST

AHEAD = 2.0  # [m] before a camera, what it looks at
OVERLAP = 2.0  # [m] between what two views look at, that may show the same
LATER = 8  # later key frames, those that look nearest first, that a view is compared with


def find(views: Views, recording: np.ndarray, key_frames: np.ndarray, progress: Callable[[np.ndarray], Iterable[int]] = iter) -> np.ndarray:
    """Find what is gone from each view, (F, v, u) bool; nothing where its pose is unknown or contradicts most of what is seen.

    recording : (F,) number of each frame's recording, in the order of time; key_frames : (K,) frames that may tell
    """
    gone = np.zeros((len(recording), *depth_views.shape(views.camera)), dtype=bool)
    has_pose = np.isfinite(views.T_wc[:, 0, 0])
    key_frames = key_frames[has_pose[key_frames]]
    spot = views.T_wc[:, :3, 3] + AHEAD * views.T_wc[:, :3, 2]
    for frame in progress(np.flatnonzero(has_pose & (recording < recording.max(initial=0)))):
        later = key_frames[(recording[key_frames] > recording[frame]) & (views.world[key_frames] == views.world[frame])]
        apart = np.linalg.norm(spot[later] - spot[frame], axis=1)
        nearest = np.argsort(apart, kind="stable")[:LATER]
        others = later[nearest[apart[nearest] < OVERLAP]]
        if len(others):
            gone[frame] = _find_in(views, int(frame), others)
    return gone


def _find_in(views: Views, frame: int, others: np.ndarray) -> np.ndarray:
    z, seen = depth_views.seen_from(views, frame, others)
    n_through, n_again = ((seen == said).sum(axis=0) for said in (kernels.THROUGH, kernels.AGAIN))
    found = kernels.groups((n_through >= FOR_MAPS.min_through) & (n_through > n_again), z, GROUP_JUMP, FOR_MAPS.min_group)
    area = z * z
    return found if area[found].sum() <= MOST * area.sum() else np.zeros_like(found)
