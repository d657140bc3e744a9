"""Verification of a loop: do the two key frames show the same place? By a rigid motion of their matches, then by the landmarks around."""

from dataclasses import replace

import numpy as np

from slamcli.config.options import LoopConfig
from slamcli.estimation import camera_pose
from slamcli.estimation.camera_pose import Ransac, SeenPoints
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.schema import Words
from slamcli.slam.loop_candidates import Candidate
from slamcli.sparse_map import landmark_pose
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.guided_matching import FrameFeatures, SearchLimits
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.vision import hamming

# Landmarks are looked for twice, from the guess and from the pose found with it, in windows so many times that of tracking.
WIDENINGS = (4.0, 2.0)
MAX_DISTANCE = 64  # bits, of 256
RATIO = 0.9  # of the best match's distance to the second best's


def verify(
    sparse_map: SparseMap, words: Words, candidate: Candidate, frames: FrameStore, settings: LoopConfig, rng: np.random.Generator
) -> Candidate:
    """Verify a candidate: find a relative pose, and with it the landmarks around j in i.

    The pose is the map's for a pair that its poses propose; of one that its words propose it is found by RANSAC over the matches with depth.
    """
    frame_i, frame_j = (frames[int(sparse_map.kf.frame[kf])] for kf in (candidate.kf_i, candidate.kf_j))
    if candidate.is_by_pose:
        return _find_landmarks(sparse_map, candidate, frame_i, se3.inverse(sparse_map.kf.T_wk[candidate.kf_i]), settings)
    rows, _ = hamming.match_nodes(_described(frame_i, words), _described(frame_j, words))
    has_depth = np.isfinite(frame_i.depth[rows[:, 0]]) & np.isfinite(frame_j.depth[rows[:, 1]])
    rows = rows[has_depth]
    candidate = replace(candidate, n_matches=len(rows))
    if len(rows) < settings.min_matches:
        return candidate.rejected(f"{len(rows)} of {settings.min_matches} matches")
    seen_i, seen_j = _points(frame_i, rows[:, 0]), _points(frame_j, rows[:, 1])
    ransac = Ransac(settings.ransac_rounds, settings.ransac_threshold_px)
    start = camera_pose.ransac_rigid(seen_j, seen_i, frames.camera, rng=rng, ransac=ransac)
    if start is None:
        return candidate.rejected("no rigid motion explains the matches")
    T_iw = product(start.T_ba, se3.inverse(sparse_map.kf.T_wk[candidate.kf_j]))
    return _find_landmarks(sparse_map, candidate, frame_i, T_iw, settings)


def find_again(sparse_map: SparseMap, candidate: Candidate, T_iw: np.ndarray, frames: FrameStore, settings: LoopConfig) -> Candidate:
    """Look for the landmarks around key frame j in key frame i, from a guess of its pose T_iw in the world that j stands in."""
    frame_i = frames[int(sparse_map.kf.frame[candidate.kf_i])]
    return _find_landmarks(sparse_map, candidate, frame_i, T_iw, settings)


def _points(frame: FrameFeatures, rows: np.ndarray) -> SeenPoints:
    """Lift some of a frame's features to where their depth puts them."""
    return SeenPoints(frame.camera.backproject(frame.xy[rows], frame.depth[rows]), frame.xy[rows])


def _described(frame: FrameFeatures, words: Words) -> hamming.Described:
    node = words.node(slice(frame.first_row, frame.first_row + len(frame)))
    return hamming.Described(frame.desc.view(np.uint8), frame.angle, node)


def _find_landmarks(
    sparse_map: SparseMap, candidate: Candidate, frame_i: FrameFeatures, T_iw: np.ndarray, settings: LoopConfig
) -> Candidate:
    """Look for the landmarks around j in i, from a guess of its pose T_iw in the world that j stands in."""
    neighbours, _ = sparse_map.covisible(candidate.kf_j)
    landmarks = sparse_map.landmarks(sparse_map.landmarks_in(np.append(neighbours[: settings.neighbours], candidate.kf_j)))
    limits, wanted = SearchLimits(settings.search_radius_px, MAX_DISTANCE, RATIO), settings.min_inliers
    for widening in WIDENINGS:
        found = landmark_pose.find(T_iw, landmarks, frame_i, limits.widened(widening), wanted=wanted)
        if found.estimate is None:
            return replace(candidate, n_inliers=found.n_found).rejected(f"{found.n_found} of {wanted} landmarks found again")
        T_iw = found.estimate.T_cw
    candidate = replace(candidate, n_inliers=found.n_agree)
    if found.n_agree < wanted:
        return candidate.rejected(f"{found.n_agree} of {wanted} landmarks agree")
    return replace(candidate, T_ij=product(T_iw, sparse_map.kf.T_wk[candidate.kf_j]))
