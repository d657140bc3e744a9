"""optimize: the whole map is adjusted at once, and the camera's timing with it; then every frame is refined against the map."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from slamcli import artifacts
from slamcli.geometry.camera import Camera
from slamcli.mapping import adjustment, hindsight, selfcalibration, timing
from slamcli.mapping.localiser import NO_RELIEFS
from slamcli.mapping.mapbuilder import MapBuilder
from slamcli.mapping.shape import Reliefs, Shape
from slamcli.schema import CoarseDepth, Features, Map, Timing, Tracks
from slamcli.stages.track import save_map_stage

SHARED = 30  # landmarks of two key frames whose depth images are aligned too


def run(inputs, out: Path, cfg, tools) -> dict:
    """Refine key frames, landmarks, timing and frames, without closures."""
    features, tracks, map_ = inputs.load(Features, "extract"), inputs.load(Tracks, "track"), inputs.load(Map, "track")
    camera = inputs.camera()
    still = Timing(readout=np.array(0.0), depth_delay=np.array(0.0), twist=timing.frame_twists(features.stamp, tracks, map_))
    when, sigma, summary = still, np.full(2, np.nan), {}
    if cfg.optimize.enabled and len(map_.kf_frame) > 1:
        builder = MapBuilder.from_map(features, map_)
        reliefs = Reliefs(inputs.load(CoarseDepth, "extract"), camera, cfg.sensor)
        tracks, when, sigma, summary = refine(builder, features, tracks, still, camera, cfg, tools, reliefs=reliefs)
        map_ = builder.snapshot()
    save_map_stage(out, features.stamp, tracks, map_)
    artifacts.save(tracks, out)
    artifacts.save(when, out)
    return {
        "frames": len(features.stamp),
        "key_frames": len(map_.kf_frame),
        "readout_ms": [round(1e3 * float(when.readout), 3), round(1e3 * float(sigma[0]), 3)],
        "depth_delay_ms": [round(1e3 * float(when.depth_delay), 3), round(1e3 * float(sigma[1]), 3)],
    } | summary


def refine(
    builder: MapBuilder, features: Features, tracks: Tracks, when: Timing, camera: Camera, cfg, tools, *, reliefs: Reliefs = NO_RELIEFS
) -> tuple[Tracks, Timing, np.ndarray, dict]:
    """Adjust the map, find the timing that suits it, and again; returns tracks, timing, its standard deviations (2,) [s], the evidence.

    The motion in `when` comes from poses, the poses from features that `when` rectified: two rounds bring both to rest.
    """
    kfs, sigma, cost = np.arange(len(builder.kf), dtype=np.int32), np.full(2, np.nan), []
    for _ in range(cfg.optimize.timing_rounds if cfg.optimize.timing else 0):
        builder.features = timing.rectify(features, when, camera)
        result = adjustment.adjust(builder, kfs, camera, cfg.sensor, max_iterations=cfg.optimize.iterations)
        found = selfcalibration.estimate_timing(
            builder, features, when, camera, cfg.sensor, prior_sigma=np.full(2, cfg.optimize.timing_prior)
        )
        if result is None or found is None:
            break
        when, sigma = found
        when = replace(when, twist=timing.frame_twists(features.stamp, tracks, builder.snapshot()))
        cost.append(result.cost[-1])
    builder.features = timing.rectify(features, when, camera)
    if cfg.optimize.shape_edges:
        T_cd = timing.depth_to_colour(features, when, builder.kf.frame)
        Shape(builder, reliefs, reliefs).join_covisible(T_cd, most=cfg.optimize.shape_edges, least=SHARED)
    result = adjustment.adjust(builder, kfs, camera, cfg.sensor, max_iterations=cfg.optimize.iterations)
    tracks = hindsight.refine_frames(builder, builder.features, tracks, camera, cfg.sensor, cfg.track, tools.progress)
    summary = {} if result is None else {"cost": [*cost, result.cost[-1]], "outliers": int((~result.is_inlier).sum())}
    return tracks, when, sigma, summary
