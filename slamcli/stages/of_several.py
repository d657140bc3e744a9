"""Where the recordings of a run of several came to lie: which share the main frame, which stand apart, and the trajectory of each."""

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import artifacts, files
from slamcli.formats import trajectory as trajectory_file
from slamcli.schema import DepthTimes, Map, Recordings, Tracks, Trajectory, frame_poses, frame_segments
from slamcli.stages.contract import Inputs
from slamcli.stages.map_outputs import segment_file

NAMES_FILE = "recordings.json"
LARGEST_NAMES = 1 << 20  # bytes


def recording_names(inputs: Inputs) -> list[str]:
    """Read the names of the recordings that were joined, in their order."""
    return [str(name) for name in json.loads(files.read_bytes(inputs.path("extract", NAMES_FILE), limit=LARGEST_NAMES))]


def recording_file(name: str) -> str:
    """Name the trajectory of a recording in the common frame."""
    return f"trajectory_{name}.txt"


@dataclass(frozen=True)
class Placed:
    """The recordings of a run under the poses of its frames."""

    names: list[str]
    recordings: Recordings
    tracks: Tracks
    map_: Map

    @cached_property
    def _segment(self) -> np.ndarray:
        return frame_segments(self.tracks, self.map_)

    @cached_property
    def recording_of_frame(self) -> np.ndarray:
        """Return the number of each frame's recording, (F,)."""
        return np.repeat(np.arange(len(self.names)), np.diff(self.recordings.recording_offset))

    def _frames(self, recording: int) -> slice:
        first, last = self.recordings.recording_offset[recording : recording + 2]
        return slice(int(first), int(last))

    def counts(self) -> list[dict[str, Any]]:
        """Count each recording's frames: all, those in the common frame, those apart in segments of their own, those lost."""
        rows = []
        for number, name in enumerate(self.names):
            segment = self._segment[self._frames(number)]
            rows.append(
                {
                    "name": name,
                    "frames": len(segment),
                    "located": int((segment == 0).sum()),
                    "apart": int((segment > 0).sum()),
                    "lost": int((segment < 0).sum()),
                }
            )
        return rows

    def warnings(self) -> list[str]:
        """Say which recordings no place joins to the others, and which parts of the others stand alone."""
        told = []
        for number, (name, count) in enumerate(zip(self.names, self.counts(), strict=True)):
            segment = self._segment[self._frames(number)]
            files_ = [segment_file(int(s)) for s in np.unique(segment[segment > 0])]
            if count["apart"] and not count["located"]:
                told.append(
                    f"the recording {name} joins nothing: no place in it was recognized for sure in the others, so it is kept apart, and no "
                    f"map shows it; its poses, in a frame of its own, are in {', '.join(files_)}"
                )
            elif count["apart"]:
                told.append(
                    f"{count['apart']} of the {count['frames']} frames of the recording {name} could not be joined: their poses, in frames "
                    f"of their own, are in {', '.join(files_)}; no map shows them"
                )
        return told

    def save(self, out: Path, depth_times: DepthTimes) -> None:
        """Write what one recording's run has no need of: when depth was measured, whose each frame is, a trajectory of each recording."""
        artifacts.save(depth_times, out)
        artifacts.save(self.recordings, out)
        for number, name in enumerate(self.names):
            trajectory_file.write_tum(out / recording_file(name), self.trajectory(number))

    def trajectory(self, recording: int) -> Trajectory:
        """Return the poses of a recording's frames in the common frame, at the stamps that the recording itself has."""
        return own_trajectory(self.recordings, self.tracks, self.map_, recording)


def own_trajectory(recordings: Recordings, tracks: Tracks, map_: Map, recording: int) -> Trajectory:
    """Return the poses of a recording's frames in the common frame, at the stamps that the recording itself has."""
    first, last = (int(frame) for frame in recordings.recording_offset[recording : recording + 2])
    T_wc = frame_poses(tracks, map_)[first:last]
    has_pose = np.isfinite(T_wc[:, 0, 0])
    return Trajectory(stamp=np.array(recordings.own_stamp[first:last][has_pose]), T_wc=T_wc[has_pose])
