"""track: features and matches -> a pose for every frame, and a map."""

from itertools import groupby
from pathlib import Path

import numpy as np

from slamcli import artifacts
from slamcli.formats import trajectory as trajectory_file
from slamcli.schema import (
    LOST,
    ON_SHAPE,
    RELOCALISED,
    CoarseDepth,
    Features,
    Map,
    Matches,
    Tracks,
    Trajectory,
    Words,
    frame_segments,
    trajectory,
)
from slamcli.slam import map_segments
from slamcli.slam.depth_tracking import Reliefs
from slamcli.slam.tracker import Tracker


def run(inputs, out: Path, cfg, tools) -> dict:
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
    save_map_stage(out, features.stamp, tracks, map_)
    artifacts.save(tracks, out)
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


def save_map_stage(out: Path, stamp: np.ndarray, tracks: Tracks, map_: Map) -> None:
    """Write what track, optimize and loop have in common: the map, the trajectory of all frames and that of the key frames.

    Other map segments than the main one have a trajectory each, in a frame of its own.
    """
    artifacts.save(map_, out)
    trajectory_file.write_tum(out / "trajectory.txt", trajectory(stamp, tracks, map_))
    trajectory_file.write_tum(out / "keyframes.txt", key_frame_trajectory(stamp, map_))
    for segment in range(1, map_segments.n_segments(map_)):
        trajectory_file.write_tum(out / segment_file(segment), trajectory(stamp, tracks, map_, segment))


def segment_file(segment: int) -> str:
    """Name the trajectory of a map segment that is not the main one."""
    return f"trajectory_segment{segment}.txt"


def key_frame_trajectory(stamp: np.ndarray, map_: Map) -> Trajectory:
    """Give the poses of the main segment's key frames alone."""
    is_main = map_.kf_segment == 0
    return Trajectory(stamp=np.array(stamp[map_.kf_frame[is_main]]), T_wc=map_.T_wk[is_main])


def segments_apart(tracks: Tracks, map_: Map) -> list[str]:
    """Tell which frames belong to other segments than the main one."""
    frames, told = frame_segments(tracks, map_), []
    for segment in range(1, map_segments.n_segments(map_)):
        of = np.flatnonzero(frames == segment)
        told.append(
            f"map segment {segment}, {len(of)} of the frames {of[0]} to {of[-1]}" if len(of) else f"map segment {segment}, no frame"
        )
    return told


def lost_spans(state: np.ndarray, reason: dict[int, str]) -> list[tuple[int, int, str]]:
    """Join lost frames next to one another with their first reason."""
    spans = []
    for _, group in groupby(enumerate(np.flatnonzero(state == LOST)), key=lambda pair: pair[1] - pair[0]):
        frames = [int(frame) for _, frame in group]
        spans.append((frames[0], frames[-1], reason.get(frames[0], "no pose was found")))
    return spans
