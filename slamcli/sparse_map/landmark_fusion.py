"""Landmark fusion: landmarks of one key frame found in another become views of it, or merge with the landmark that is there."""

import numpy as np

from slamcli.geometry import se3
from slamcli.sparse_map import guided_matching
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.guided_matching import SearchLimits
from slamcli.sparse_map.sparse_map import SparseMap

WITHIN_SIGMA = 3.0  # of the projection, and of the depth reading, that a feature must lie
# [of the depth] beside the noise of the reading: the landmark's own depth was read once, maybe from another distance.
DEPTH_MARGIN = 0.02


def fuse_landmarks(sparse_map: SparseMap, kf: int, ids: np.ndarray, frames: FrameStore, *, max_distance: int) -> int:
    """Look for landmarks in a key frame: a free feature becomes a view, a landmark that is there already is fused.

    ids : (N,) landmarks; frames : of the recording that the map is of; max_distance : of descriptors [bits]
    Returns how many were found. A feature must lie within 3 sigma of the projection, in depth too.
    """
    ids = np.setdiff1d(ids, sparse_map.landmarks_of(kf))
    if len(ids) == 0:
        return 0
    frame = frames[int(sparse_map.kf.frame[kf])]
    T_kw = se3.inverse(sparse_map.kf.T_wk[kf])
    limits = SearchLimits(radius_px=WITHIN_SIGMA * frames.sensor.pixel_noise, max_distance=max_distance, ratio=1.0)
    feature, _ = guided_matching.search(T_kw, sparse_map.landmarks(ids), frame, limits)
    which = np.flatnonzero(feature >= 0)
    z = se3.transform(T_kw, sparse_map.lm.xyz[ids[which]])[:, 2]
    f = feature[which]
    agrees = ~(np.abs(z - frame.depth[f]) > WITHIN_SIGMA * frame.sigma_z[f] + DEPTH_MARGIN * z)
    which, f = which[agrees], f[agrees]
    there = sparse_map.lm_of_row[frame.first_row + f]
    is_free = there < 0
    sparse_map.observe(kf, ids[which[is_free]], frame.first_row + f[is_free])
    sparse_map.fuse(there[~is_free], ids[which[~is_free]])
    return len(which)
