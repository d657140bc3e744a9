"""The recordings of a run of several, each judged in the common frame: one alignment holds for all."""

from dataclasses import replace
from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.evaluation import trajectory_error
from slamcli.evaluation.trajectory_error import Ape
from slamcli.runs.run_directory import RunDir
from slamcli.schema import FrameTimes, Map, Recordings, Tracks, Trajectory, frame_segments, trajectory


def number_of(run: RunDir, name: str) -> int:
    """Look up a recording of a run by its name; SlamError names those there are."""
    names = [entry["name"] for entry in run.recordings]
    if name not in names:
        told = f"its recordings are {', '.join(names)}" if names else "it is a run of one recording"
        raise SlamError(f"{run.path}: no recording {name!r}; {told}")
    return names.index(name)


def part(run: RunDir, name: str, whole: Trajectory) -> Trajectory:
    """Return the poses of one recording out of a trajectory of its run, in the same frame, at the stamps that the recording itself has."""
    number, (stamp, recordings) = number_of(run, name), _recordings(run)
    frame = np.searchsorted(stamp, whole.stamp)
    first, last = recordings.recording_offset[number : number + 2]
    here = (frame >= first) & (frame < last)
    return Trajectory(stamp=np.array(recordings.own_stamp[frame[here]]), T_wc=whole.T_wc[here])


def frame_count(run: RunDir, name: str) -> int:
    """Return how many frames one recording of a run has."""
    number = number_of(run, name)
    return int(np.diff(_recordings(run)[1].recording_offset)[number])


def _recordings(run: RunDir) -> tuple[np.ndarray, Recordings]:
    """Return the stamp of each frame (F,) [s] and which recording it is of, as loop keeps them, or extract before loop was run."""
    stage = "extract" if run.record("loop") is None else "loop"
    return run.load(FrameTimes, stage).stamp, run.load(Recordings, stage)


def apes(run: RunDir, whole: Ape, truth: Trajectory) -> list[Ape]:
    """Split the error of a run's trajectory by recording, in its order, under the one alignment.

    A recording that is kept apart has a frame of its own, so that it is aligned alone, and called so; one without a pose has no error.
    """
    stamp, recordings = _recordings(run)
    tracks, map_ = run.load(Tracks, whole.stage), run.load(Map, whole.stage)
    segment, offset = frame_segments(tracks, map_), recordings.recording_offset
    found = []
    for number, entry in enumerate(run.recordings):
        frames = np.arange(int(offset[number]), int(offset[number + 1]))
        here = segment[frames]
        if (here == 0).any():
            found.append(_split(whole, stamp[frames], entry["name"], n_poses=int((here == 0).sum())))
        elif (here > 0).any():
            largest = int(np.bincount(here[here > 0]).argmax())
            alone = trajectory(np.asarray(stamp), tracks, map_, largest)
            apart = f"{entry['name']} (apart)"
            found.append(trajectory_error.ape(alone, truth, n_frames=len(frames), name=apart, stage=whole.stage))
    return found


def _split(whole: Ape, stamp: np.ndarray, name: str, *, n_poses: int) -> Ape:
    """Take the frames at `stamp` (N,) [s] out of a trajectory's error."""
    here = np.isin(whole.stamp, stamp)
    columns: dict[str, Any] = {column: getattr(whole, column)[here] for column in ("stamp", "error", "x_truth", "x_aligned")}
    return replace(whole, name=name, n_frames=len(stamp), n_poses=n_poses, **columns)
