"""Final refinement: key frames by their depth images, then every frame by landmarks, meet the final map again. Only a batch program can."""

from dataclasses import dataclass, replace

import numpy as np

from slamcli.calibration import rolling_shutter
from slamcli.config.options import TrackConfig
from slamcli.estimation.bundle_adjustment import BundleResult
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.schema import Timing, Tracks
from slamcli.slam.depth_tracking import DepthAligner, FramePoints
from slamcli.slam.frame_refinement import refine_frames
from slamcli.slam.recording import TrackedRecording
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap

SHARED = 30  # landmarks of two key frames whose depth images are aligned too


@dataclass(frozen=True)
class DepthConstraints:
    """What depth images are to say of how key frames lie to one another."""

    points: FramePoints  # of the recording that the map is of
    timing: Timing  # when its depth was measured, and when colour
    most: int  # covisible key frames that each one is aligned with; 0 = none
    weight: float = 1.0  # factor on the information of all edges in the adjustment


@dataclass(frozen=True)
class Refinement:
    """Settings of the final refinement."""

    settings: TrackConfig
    depth: DepthConstraints
    iterations: int  # of the adjustment


def refine_all(
    sparse_map: SparseMap, tracked: TrackedRecording, by: Refinement, *, progress, workers: int = 1
) -> tuple[Tracks, BundleResult | None]:
    """Align the depth images of covisible key frames, adjust the map, and refine every frame against it.

    sparse_map : its map is changed; tracked : the recording that it is of, its features corrected by what is known of the camera
    workers : threads; the result is the same with any number
    Returns the refined tracks, and the evidence of the adjustment, None where nothing ties two key frames together.
    """
    frames, depth = tracked.frames, by.depth
    if depth.most:
        T_cd = rolling_shutter.depth_to_colour(frames.features, depth.timing, sparse_map.kf.frame)
        points = depth.points.under(frames.camera)
        DepthAligner(sparse_map, points, points).add_covisible_edges(T_cd, most=depth.most, least=SHARED, workers=workers)
    kfs = np.arange(len(sparse_map.kf), dtype=np.int32)
    result = map_adjustment.adjust(sparse_map, kfs, frames.camera, frames.sensor, max_iterations=by.iterations, edge_weight=depth.weight)
    tracks = refine_frames(sparse_map, tracked, by.settings, progress, workers=workers)
    return move_key_frames(sparse_map, tracks), result


def move_key_frames(sparse_map: SparseMap, tracks: Tracks) -> Tracks:
    """Move each key frame to where its frame stands, landmarks staying, and hang all frames on the key frames again.

    The oldest key frame of each segment is its world's origin: instead of it, all else moves.
    """
    table, has_pose = sparse_map.kf, tracks.ref_kf >= 0
    ref, T_wc = tracks.ref_kf[has_pose], np.full(tracks.T_kc.shape, np.nan)
    T_wc[has_pose] = product(table.T_wk[ref], tracks.T_kc[has_pose])
    for oldest in np.unique(table.segment, return_index=True)[1]:
        shift = product(table.T_wk[oldest], se3.inverse(T_wc[table.frame[oldest]]))
        is_here = table.segment == table.segment[oldest]
        frames = np.flatnonzero(has_pose)[is_here[ref]]
        T_wc[frames] = product(shift, T_wc[frames])
        ids = np.flatnonzero(sparse_map.lm.is_alive & is_here[sparse_map.lm.first_kf])
        sparse_map.lm.xyz[ids] = se3.transform(shift, sparse_map.lm.xyz[ids])
    table.T_wk[:] = T_wc[table.frame]
    T_kc = np.full(T_wc.shape, np.nan)
    T_kc[has_pose] = product(se3.inverse(table.T_wk[ref]), T_wc[has_pose])
    T_kc[table.frame] = np.eye(4)
    return replace(tracks, T_kc=T_kc)
