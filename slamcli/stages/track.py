"""track: features and matches -> a pose for every frame, and a map."""

from itertools import groupby
from pathlib import Path

import numpy as np

from slamcli.config.options import Config
from slamcli.schema import (
    LOST,
    ON_SHAPE,
    RELOCALISED,
    CoarseDepth,
    Features,
    Matches,
    Words,
)
from slamcli.slam import map_segments
from slamcli.slam.depth_tracking import Reliefs
from slamcli.slam.tracker import Tracker
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.map_outputs import save_map


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Track every frame and build the map of key frames and landmarks."""
    features = inputs.load(Features, "extract")
    tracker = Tracker(
        features, inputs.load(Words, "match"), inputs.load(Matches, "match"), inputs.camera(), cfg.track, cfg.sensor, tools.rng(),
        reliefs=Reliefs(inputs.load(CoarseDepth, "extract"), inputs.camera(), cfg.sensor),
    )  # fmt: skip
    for i in tools.progress(range(len(features.stamp)), "track"):
        tracker.process(i)
    tracks = tracker.tracks()
    map_ = map_segments.anchored(map_segments.ranked(tracker.map(), tracks), tracks)
    lost = lost_spans(tracks.state, tracker.lost_reason)
    for first, last, reason in lost:
        tools.warn(f"frames {first} to {last} are lost: {reason}" if last > first else f"frame {first} is lost: {reason}")
    save_map(out, features.stamp, tracks, map_)
    return {
        "frames": len(features.stamp),
        "tracked": int((tracks.state != LOST).sum()),
        "lost": int((tracks.state == LOST).sum()),
        "relocalised": int((tracks.state == RELOCALISED).sum()),
        "on_shape": int((tracks.state == ON_SHAPE).sum()),
        "segments": map_segments.n_segments(map_),
        "key_frames": len(map_.kf_frame),
        "landmarks": len(map_.lm_xyz),
        "edges": len(map_.edge_kf),
        "lost_spans": [list(span) for span in lost],
    }


def lost_spans(state: np.ndarray, reason: dict[int, str]) -> list[tuple[int, int, str]]:
    """Join lost frames next to one another with their first reason."""
    spans = []
    for _, group in groupby(enumerate(np.flatnonzero(state == LOST)), key=lambda pair: pair[1] - pair[0]):
        frames = [int(frame) for _, frame in group]
        spans.append((frames[0], frames[-1], reason.get(frames[0], "no pose was found")))
    return spans
