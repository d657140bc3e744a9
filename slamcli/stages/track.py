"""track: features and matches -> a pose for every frame, and a map."""

from itertools import groupby
from pathlib import Path

import numpy as np

from slamcli import artifacts
from slamcli.formats import trajectory as trajectory_file
from slamcli.mapping.tracker import Tracker
from slamcli.schema import LOST, RELOCALISED, Features, Map, Matches, Tracks, Trajectory, Words, trajectory


def run(inputs, out: Path, cfg, tools) -> dict:
    """Track every frame and build the map of key frames and landmarks."""
    features = inputs.load(Features, "extract")
    tracker = Tracker(
        features, inputs.load(Words, "match"), inputs.load(Matches, "match"), inputs.camera(), cfg.track, cfg.sensor, tools.rng()
    )
    for i in tools.progress(range(len(features.stamp)), "track"):
        tracker.process(i)
    tracks, map_ = tracker.tracks(), tracker.map()
    lost = lost_spans(tracks.state, tracker.lost_reason)
    for first, last, reason in lost:
        tools.warn(f"frames {first} to {last} are lost: {reason}" if last > first else f"frame {first} is lost: {reason}")
    save_map_stage(out, features.stamp, tracks, map_)
    artifacts.save(tracks, out)
    return {
        "frames": len(features.stamp),
        "tracked": int((tracks.state != LOST).sum()),
        "lost": int((tracks.state == LOST).sum()),
        "relocalised": int((tracks.state == RELOCALISED).sum()),
        "key_frames": len(map_.kf_frame),
        "landmarks": len(map_.lm_xyz),
        "lost_spans": [list(span) for span in lost],
    }


def save_map_stage(out: Path, stamp: np.ndarray, tracks: Tracks, map_: Map) -> None:
    """Write what track, optimize and loop have in common: the map, the trajectory of all frames and that of the key frames."""
    artifacts.save(map_, out)
    trajectory_file.write_tum(out / "trajectory.txt", trajectory(stamp, tracks, map_))
    trajectory_file.write_tum(out / "keyframes.txt", key_frame_trajectory(stamp, map_))


def key_frame_trajectory(stamp: np.ndarray, map_: Map) -> Trajectory:
    """Give the poses of the key frames alone."""
    return Trajectory(stamp=np.array(stamp[map_.kf_frame]), T_wc=map_.T_wk)


def lost_spans(state: np.ndarray, reason: dict[int, str]) -> list[tuple[int, int, str]]:
    """Join lost frames next to one another with their first reason."""
    spans = []
    for _, group in groupby(enumerate(np.flatnonzero(state == LOST)), key=lambda pair: pair[1] - pair[0]):
        frames = [int(frame) for _, frame in group]
        spans.append((frames[0], frames[-1], reason.get(frames[0], "no pose was found")))
    return spans
