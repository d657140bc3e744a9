"""optimize: the whole map is adjusted at once, and with it what is not known of the camera; then every frame is refined against the map."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import artifacts
from slamcli.calibration import measurement_derivatives, rolling_shutter, self_calibration
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import Config
from slamcli.schema import Features, FrameTimes, Map, Moving, Rests, Timing, Tracks
from slamcli.slam import calibration_doubt, doubt, final_refinement, map_segments, rests
from slamcli.slam.depth_tracking import NO_FRAME_POINTS, FramePoints
from slamcli.slam.final_refinement import DepthConstraints, Refinement
from slamcli.slam.recording import TrackedRecording
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import moving_parts
from slamcli.stages.camera_file import write_camera
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.map_outputs import save_map


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Refine key frames, landmarks, what is not known of the camera, and frames, without closures."""
    tracks, map_ = inputs.load(Tracks, "track"), inputs.load(Map, "track")
    features, depth = moving_parts.still(inputs, inputs.load(Moving, "track"))
    given = inputs.camera()
    delay = np.array(0.0 if cfg.optimize.move_depth else np.nan)
    still = Timing(np.array(0.0), np.array(0.0), depth_delay=delay, twist=rolling_shutter.frame_twists(features.stamp, tracks, map_))
    sensing, summary = Sensing(given, still, {}), dict[str, Any]()
    if cfg.optimize.enabled and len(map_.kf_frame) > 1:
        sparse_map = SparseMap.from_map(features, map_)
        extracted = Extracted(features, FramePoints(depth, given, cfg.sensor), inputs.load(Rests, "track"))
        tracks, sensing, summary = refine(sparse_map, extracted, tracks, sensing, cfg, tools)
        doubts = calibration_doubt.judge(sparse_map, sensing, cfg.sensor)
        for one in doubts:
            tools.warn(one.text)
        summary |= doubt.to_summary(doubts)
        map_ = map_segments.from_first_frames(sparse_map.snapshot(), tracks)
    save_map(out, inputs.load(FrameTimes, "extract"), tracks, map_)
    artifacts.save(sensing.timing, out)
    write_camera(out, sensing.camera)
    return {"frames": len(features.stamp), "key_frames": len(map_.kf_frame)} | figures(sensing) | summary


@dataclass(frozen=True)
class Extracted:
    """What extract measured of a recording, under the calibration that it was given, and what track found out of it."""

    features: Features
    points: FramePoints = NO_FRAME_POINTS
    stands_still: Rests = rests.NONE


def refine(
    sparse_map: SparseMap, extracted: Extracted, tracks: Tracks, sensing: Sensing, cfg: Config, tools: Tools
) -> tuple[Tracks, Sensing, dict]:
    """Adjust the map, find what of the camera suits it, and again; returns tracks, what was found, and the evidence.

    sensing : what is known of the camera before. The motion in it comes from poses, the poses from features that it corrected: two
    rounds bring both to rest.
    """
    features = extracted.features
    kfs, given, cost = np.arange(len(sparse_map.kf), dtype=np.int32), sensing.camera, []
    prior = self_calibration.unknowns(given, cfg.optimize)
    for _ in range(cfg.optimize.rounds if prior else 0):
        sparse_map.features = self_calibration.correct(features, given, sensing)
        result = map_adjustment.adjust(sparse_map, kfs, sensing.camera, cfg.sensor, max_iterations=cfg.optimize.iterations)
        found = self_calibration.estimate_sensing(sparse_map, given, sensing, cfg.sensor, prior=prior)
        if result is None or found is None:
            break
        twist = rolling_shutter.frame_twists(features.stamp, tracks, sparse_map.snapshot())
        sensing = replace(found, timing=replace(found.timing, twist=twist))
        cost.append(result.cost[-1])
    sparse_map.features = self_calibration.correct(features, given, sensing)
    frames = FrameStore(sparse_map.features, sensing.camera, cfg.sensor)
    depth = DepthConstraints(extracted.points, sensing.timing, most=cfg.optimize.depth_icp_edges)
    by, tracked = Refinement(cfg.track, depth, cfg.optimize.iterations), TrackedRecording(frames, tracks, extracted.stands_still)
    tracks, result = final_refinement.refine_all(sparse_map, tracked, by, progress=tools.progress, workers=tools.workers)
    summary = {} if result is None else {"cost": [*cost, result.cost[-1]], "outliers": int((~result.is_inlier).sum())}
    return tracks, sensing, summary


def figures(sensing: Sensing) -> dict:
    """Tell the numbers found with their standard deviations."""
    figures = {}
    for name, sigma in sensing.sigma.items():
        is_time = name in measurement_derivatives.TIMES
        unit = 1e3 if is_time else 1.0
        value = getattr(sensing.timing if is_time else sensing.camera, name)
        figures[f"{name}_ms" if is_time else name] = [float(f"{unit * one:.6g}") for one in (float(value), sigma)]
    return figures
