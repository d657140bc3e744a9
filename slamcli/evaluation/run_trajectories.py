"""The trajectories that a run and its recording hold, as `trajectory_error` compares them: estimated, true, and those not doubted."""

from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.evaluation.trajectory_error import Ape, rmse
from slamcli.hints import hint
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Doubt, FrameTimes, Map, Tracks, Trajectory, trajectory
from slamcli.stages import WITH_TRAJECTORY


def last_stage(run: RunDir) -> str:
    """Name the last stage of a run that holds a trajectory."""
    for stage in reversed(WITH_TRAJECTORY):
        if run.record(stage) is not None:
            return stage
    raise SlamError(f"{run.path}: no stage has made a trajectory yet; try: {hint().update(run.path, until='track')}")


def stage_trajectory(run: RunDir, stage: str) -> Trajectory:
    """Return the poses of all frames that have one after a stage."""
    return trajectory(run.load(FrameTimes, stage).stamp, run.load(Tracks, stage), run.load(Map, stage))


def sure_part(run: RunDir, whole: Trajectory) -> Trajectory:
    """Leave out of a run's trajectory the frames whose poses its loop stage doubts; SlamError where that has not been run."""
    stamp, doubts = run.load(FrameTimes, "loop").stamp, run.load(Doubt, "loop")
    is_sure = ~np.isin(whole.stamp, stamp[doubts.is_doubtful])
    return Trajectory(stamp=whole.stamp[is_sure], T_wc=whole.T_wc[is_sure])


def sure_figures(run: RunDir, found: Ape) -> dict[str, Any]:
    """Count the frames that a run doubts, and give the RMSE [m] of the others; None where another stage's or system's poses were measured."""
    if found.stage != "loop":
        return {"doubtful": None, "rmse_sure": None}
    doubts = run.load(Doubt, "loop")
    error = found.error[~np.isin(found.stamp, run.load(FrameTimes, "loop").stamp[doubts.is_doubtful])]
    return {"doubtful": doubts.n_doubtful, "rmse_sure": rmse(error) if len(error) else None}


def frame_count(run: RunDir) -> int:
    """Count the colour frames of a run's recording, as any of its stages knows them."""
    records = (run.record(stage) for stage in ("extract", *reversed(WITH_TRAJECTORY)))
    return next(int(record["summary"]["frames"]) for record in records if record is not None)


def ground_truth(run: RunDir) -> Trajectory:
    """Return the true trajectory of a run's recording; SlamError when there is none."""
    dataset = run.dataset()
    truth = dataset.ground_truth()
    if truth is None:
        raise SlamError(
            f"{dataset.root}: no ground truth, so there is nothing to compare with; "
            f"put a groundtruth.txt (timestamp tx ty tz qx qy qz qw) there, give one with {hint().argument('truth')}, or look at the result with: {hint().report(run.path)}"
        )
    return truth
