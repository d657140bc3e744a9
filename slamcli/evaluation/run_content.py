"""Everything the page says, gathered from the run directory."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slamcli import schema
from slamcli.datasets import Dataset
from slamcli.errors import Damaged, SlamError
from slamcli.evaluation import map_verdict, of_several, run_trajectories, trajectory_error
from slamcli.evaluation.map_verdict import Verdict
from slamcli.evaluation.trajectory_error import Ape
from slamcli.geometry import se3
from slamcli.hints import hint
from slamcli.runs import placement
from slamcli.runs.run_directory import RunDir
from slamcli.runs.staleness import State
from slamcli.schema import LOST, Closures, Doubt, Features, FrameTimes, Ground, Map, Tracks, Trajectory
from slamcli.stages import WITH_TRAJECTORY

UPRIGHT = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)  # world to level, no floor known


MOST_TRUTH_POINTS = 6000
TRUTH_GAP = 1.0  # [s] without truth, over which its path is not drawn on


@dataclass(frozen=True)
class Content:
    """A run as the page shows it. `F` frames; poses in the level frame, z up."""

    name: str
    update: str  # what brings the run up to date, as a hint
    stage: str  # whose trajectory is shown
    stamp: np.ndarray  # (F,) [s]
    T_lc: np.ndarray  # (F, 4, 4), NaN = lost
    state: np.ndarray  # (F,) as in Tracks
    n_inliers: np.ndarray  # (F,)
    n_features: np.ndarray  # (F,); empty where extract is not there any more
    is_doubtful: np.ndarray  # (F,) whose pose the run itself doubts
    loops: np.ndarray  # (C, 2) frames
    ground: Ground | None
    ape: dict[str, Ape]  # by stage; empty without ground truth
    ape_of: list[Ape]  # of each of several recordings, after the last stage; empty where there is one
    no_truth: str  # why there is none, or ""
    x_truth: np.ndarray  # (N, 3) level frame; a row of NaN interrupts it
    states: dict[str, State]
    cleaned: frozenset[str]  # stages that were deleted on purpose, and those that were made from them
    recording: dict[str, Any]
    recording_warnings: list[str] = field(default_factory=list)  # of its reader, or why it could not be opened
    verdict: Verdict | None = None  # on the map, where there is one
    starts: np.ndarray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))  # (R,) first frame of each recording
    names: list[str] = field(default_factory=list)  # of several recordings

    @property
    def has_pose(self) -> np.ndarray:
        """Say which frames have a pose."""
        return np.isfinite(self.T_lc[:, 0, 0])

    @property
    def path(self) -> np.ndarray:
        """Return the camera centres (N, 3) of the frames that have a pose, with a row of NaN between recordings."""
        parts = [part[np.isfinite(part[:, 0])] for part in np.split(self.T_lc[:, :3, 3], self.starts[1:])]
        rows = [row for part in parts if len(part) for row in (np.full((1, 3), np.nan), part)]
        return np.concatenate(rows[1:]) if rows else np.empty((0, 3))

    @property
    def seconds(self) -> float:
        """Return how long was recorded [s], what lies between recordings left out."""
        return float(sum(part[-1] - part[0] for part in np.split(self.stamp, self.starts[1:])))

    @property
    def n_lost(self) -> int:
        """Count the frames that no map segment holds."""
        return int((self.state == LOST).sum())

    @property
    def n_apart(self) -> int:
        """Count the frames of map segments that could not be joined to the main one."""
        return len(self.stamp) - self.n_lost - int(self.has_pose.sum())

    def summary(self, stage: str) -> dict[str, Any]:
        """Return what a stage said of itself; nothing where it was not run."""
        return self.states[stage].record.get("summary", {})


def collect(run: RunDir, dataset: Dataset | None = None) -> Content:
    """Gather a run; it may have ended after any stage from track on. `dataset` : its recording, where it is open already."""
    stage = run_trajectories.last_stage(run)
    times, map_, tracks = run.load(FrameTimes, stage), run.load(Map, stage), run.load(Tracks, stage)
    ground = run.load(Ground, "densify") if run.record("densify") is not None else None
    T_lw = ground.T_lw if ground is not None else UPRIGHT
    T_lc = T_lw @ schema.frame_poses(tracks, map_)
    dataset, not_there = (dataset, "") if dataset is not None else _opened(run)
    truth, no_truth = _truth(dataset, not_there)
    ape = _ape(run, times.stamp, truth)
    recording = _recording(run, stage)
    recording_warnings = list(dataset.warnings) if dataset is not None else [not_there]
    states = run.states()
    return Content(
        name=str(run.info()["dataset"]),
        update=hint().update(run.path),
        stage=stage,
        stamp=np.array(times.stamp),
        T_lc=T_lc,
        state=np.array(tracks.state),
        n_inliers=np.array(tracks.n_inliers),
        n_features=np.diff(run.load(Features, "extract").offset) if run.record("extract") is not None else np.zeros(0, dtype=np.int64),
        is_doubtful=np.array(run.load(Doubt, "loop").is_doubtful) if stage == "loop" else np.zeros(len(times.stamp), dtype=bool),
        loops=_loops(run, stage, map_),
        ground=ground,
        ape=ape,
        ape_of=of_several.apes(run, ape[stage], truth) if run.recordings and truth is not None and stage in ape else [],
        no_truth=no_truth,
        x_truth=_truth_in_level(truth, ape.get(stage), T_lw),
        states=states,
        cleaned=frozenset(name for name, state in states.items() if not state.is_fresh and run.is_cleaned(state)),
        recording=recording,
        recording_warnings=recording_warnings,
        verdict=map_verdict.of_run(run),
        starts=placement.beginnings(run),
        names=[str(entry["name"]) for entry in run.recordings],
    )


def _opened(run: RunDir) -> tuple[Dataset | None, str]:
    """Open the recording; None, and why, where it cannot be: it may be gone by now."""
    try:
        return run.dataset(), ""
    except SlamError as error:
        return None, str(error)


def _truth(dataset: Dataset | None, not_there: str) -> tuple[Trajectory | None, str]:
    if dataset is None:
        return None, not_there
    try:
        truth = dataset.ground_truth()
    except SlamError as error:
        return None, str(error)
    return truth, "" if truth is not None else "The recording has no ground truth, so errors cannot be given."


def _ape(run: RunDir, stamp: np.ndarray, truth: Trajectory | None) -> dict[str, Ape]:
    found: dict[str, Ape] = {}
    if truth is None:
        return found
    for stage in WITH_TRAJECTORY:
        if run.record(stage) is not None:
            try:
                found[stage] = trajectory_error.ape(
                    run_trajectories.stage_trajectory(run, stage), truth, n_frames=len(stamp), name=stage, stage=stage
                )
            except Damaged:
                raise
            except SlamError:  # too few poses to align: the page says how many there are
                continue
    return found


def _truth_in_level(truth: Trajectory | None, ape: Ape | None, T_lw: np.ndarray) -> np.ndarray:
    """Move the true path to where the estimate lies, for the time that the estimate covers."""
    if truth is None or ape is None:
        return np.empty((0, 3))
    during = np.flatnonzero((truth.stamp >= ape.stamp[0]) & (truth.stamp <= ape.stamp[-1]))
    during = during[:: -(-len(during) // MOST_TRUTH_POINTS) or 1]
    x_l = se3.transform(T_lw @ se3.inverse(ape.T_gw), truth.T_wc[during, :3, 3])
    return np.insert(x_l, 1 + np.flatnonzero(np.diff(truth.stamp[during]) > TRUTH_GAP), np.nan, axis=0)


def _loops(run: RunDir, stage: str, map_: Map) -> np.ndarray:
    if stage != "loop":
        return np.empty((0, 2), dtype=np.int32)
    kf = run.load(Closures, "loop").closure_kf
    return map_.kf_frame[kf[(map_.kf_segment[kf] == 0).all(axis=1)]]


def _recording(run: RunDir, stage: str) -> dict[str, Any]:
    """Describe the recording by what the run holds of it."""
    made_by = "extract" if run.record("extract") is not None else stage
    about: dict[str, Any] = {"root": run.info()["root"], "camera": run.camera(made_by).to_dict()}
    placed = (run.record("loop") or {}).get("summary", {}).get("recordings", [])
    about["recordings"] = {row["name"]: f"{row['located']} of {row['frames']} frames in the common frame" for row in placed}
    return about
