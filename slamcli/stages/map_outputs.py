"""The files that track, optimize and loop have in common: the map and the trajectories."""

from pathlib import Path

import numpy as np

from slamcli import artifacts
from slamcli.formats import trajectory as trajectory_file
from slamcli.schema import FrameTimes, Map, Tracks, Trajectory, frame_segments, trajectory
from slamcli.slam import map_segments


def save_map(out: Path, times: FrameTimes, tracks: Tracks, map_: Map) -> None:
    """Write the map, the times and poses of all frames, the trajectory of the frames and that of the key frames.

    Other map segments than the main one have a trajectory each, in a frame of its own.
    """
    for artifact in (map_, tracks, times):
        artifacts.save(artifact, out)
    stamp = times.stamp
    trajectory_file.write_tum(out / "trajectory.txt", trajectory(stamp, tracks, map_))
    trajectory_file.write_tum(out / "keyframes.txt", key_frame_trajectory(stamp, map_))
    for segment in range(1, map_segments.n_segments(map_)):
        trajectory_file.write_tum(out / segment_file(segment), trajectory(stamp, tracks, map_, segment))


def segment_file(segment: int) -> str:
    """Name the trajectory of a map segment that is not the main one."""
    return f"trajectory_segment{segment}.txt"


def key_frame_trajectory(stamp: np.ndarray, map_: Map) -> Trajectory:
    """Return the poses of the main segment's key frames alone."""
    is_main = map_.kf_segment == 0
    return Trajectory(stamp=np.array(stamp[map_.kf_frame[is_main]]), T_wc=map_.T_wk[is_main])


def describe_other_segments(tracks: Tracks, map_: Map) -> list[str]:
    """Say of each map segment but the main one which frames belong to it."""
    frames, described = frame_segments(tracks, map_), []
    for segment in range(1, map_segments.n_segments(map_)):
        of = np.flatnonzero(frames == segment)
        described.append(
            f"map segment {segment}, {len(of)} of the frames {of[0]} to {of[-1]}" if len(of) else f"map segment {segment}, no frame"
        )
    return described
