"""Map segments, which begin where tracking was lost for good: which is the main one, and the world that each is expressed in."""

from dataclasses import replace

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.schema import Map, Tracks, frame_poses, frame_segments


def ranked(map_: Map, tracks: Tracks, main: int = 0) -> Map:
    """Number the segments by their frames, most first and of equals the earlier; then the one numbered `main` becomes 0."""
    n = n_segments(map_)
    frames = frame_segments(tracks, map_)
    size = np.bincount(frames[frames >= 0], minlength=n)
    order = np.argsort(-size, kind="stable")
    order = np.concatenate([order[main : main + 1], np.delete(order, main)]) if main < n else order
    return replace(map_, kf_segment=np.argsort(order)[map_.kf_segment].astype(np.int32))


def from_first_frames(map_: Map, tracks: Tracks) -> Map:
    """Express each segment in the camera frame of its first frame with a pose, so that every trajectory begins at the identity.

    Joining two segments, or finding a frame before the first key frame, leaves another camera than the first at the world's origin.
    """
    T_wk, lm_xyz = map_.T_wk.copy(), map_.lm_xyz.copy()
    first_obs = np.searchsorted(map_.obs_lm, np.arange(len(lm_xyz)))
    lm_segment = map_.kf_segment[map_.obs_kf[first_obs]]
    for segment in range(n_segments(map_)):
        T_wc = frame_poses(tracks, map_, segment)
        frames = np.flatnonzero(np.isfinite(T_wc[:, 0, 0]))
        if len(frames) == 0:
            continue
        T_cw = se3.inverse(T_wc[frames[0]])
        kfs, lms = map_.kf_segment == segment, lm_segment == segment
        T_wk[kfs] = product(T_cw, T_wk[kfs])
        lm_xyz[lms] = se3.transform(T_cw, lm_xyz[lms])
    return replace(map_, T_wk=T_wk, lm_xyz=lm_xyz)


def n_segments(map_: Map) -> int:
    """Return the number of segments."""
    return int(map_.kf_segment.max(initial=-1)) + 1
