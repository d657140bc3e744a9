"""How far the maps agree with what the camera saw and, for a simulated recording, with the scene it was made from."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.association import associate
from slamcli.dense import occupancy
from slamcli.errors import BadFrame
from slamcli.evaluation import grid_truth, run_trajectories, trajectory_error
from slamcli.formats import octomap
from slamcli.formats.mask import read_mask
from slamcli.geometry import se3
from slamcli.navigation import grid
from slamcli.runs.run_directory import RunDir
from slamcli.schema import FrameTimes, Grid, Ground, Map, Moving, Tracks, frame_poses
from slamcli.stages.depth_frames import DepthFrames, depth_poses
from slamcli.stages.octree import scans

Progress = Callable[..., Iterable]


def octree_accuracy(run: RunDir, *, progress: Progress) -> dict[str, Any]:
    """Replay the key frames' depth against the octree: the share of cells whose state is what the scan says.

    A. Hornung et al., OctoMap, Autonomous Robots 2013, section 5.2, doi:10.1007/s10514-012-9321-0
    """
    tree, config = octomap.read(run.stage_path("octree", "map.ot")), run.config()
    T_lw = run.load(Ground, "densify").T_lw
    poses = [(frame, T_lw @ T_wk) for frame, T_wk in depth_poses(run, frames="key")]
    depths = DepthFrames(run.dataset(), run.camera("loop"), run.load(Moving, "loop"), config.run.workers)
    replay = scans(depths, progress(poses, "eval map"), config.sensor, config.octree)
    found = occupancy.accuracy(tree, replay, max_range=config.octree.max_range)
    share = float(found.share) if np.isfinite(found.share) else None
    return {"accuracy": share, "correct": found.correct, "wrong": found.wrong, "unknown": found.unknown, "scans": len(poses)}


def has_scene(run: RunDir) -> bool:
    """Say whether a run's recording is a simulated one that brings its scene along."""
    return _scene_file(run).is_file()


def _scene_file(run: RunDir) -> Path:
    """Name the scene that a run's recording was made from; of several, that of the first which the maps show."""
    placed = ((run.record("loop") or {}).get("summary", {})).get("recordings", [])
    shown = [entry["root"] for entry, row in zip(run.recordings, placed, strict=False) if row["located"]]
    return Path(shown[0] if shown else run.info()["root"]) / "scene.json"


def grid_score(run: RunDir, *, progress: Progress) -> dict[str, Any]:
    """Compare the grid with the scene: shares of cells right, and whether the special boxes are in it."""
    dataset, camera, settings = run.dataset(), run.camera("loop"), run.config().grid2d
    scene, cells = grid_truth.read_scene(_scene_file(run)), run.load(Grid, "grid2d")
    times, T_lw, truth = run.load(FrameTimes, "loop"), run.load(Ground, "densify").T_lw, run_trajectories.ground_truth(run)
    aligned = trajectory_error.ape(run_trajectories.stage_trajectory(run, "loop"), truth, n_frames=len(times.stamp), name=str(run.path))
    T_sl = aligned.T_gw @ se3.inverse(T_lw)  # a simulated recording's truth is given in its scene's frame
    T_lc = T_lw @ frame_poses(run.load(Tracks, "loop"), run.load(Map, "loop"))
    frames = grid.spaced(T_lc, metres=settings.spacing, degrees=settings.spacing_deg)
    frames = frames[np.isfinite(times.depth_stamp[frames])]

    def points() -> Iterable[np.ndarray]:
        """Return what each frame that the grid is made from truly showed."""
        for row, true_row in progress(associate(times.depth_stamp[frames], truth.stamp), "eval map"):
            try:
                depth = dataset.depth(int(frames[row]))
            except BadFrame:
                continue
            if depth is not None:
                still = without_people(depth, _scene_file(run).parent, float(times.stamp[frames[row]]))
                yield grid_truth.exact_points(scene, still, truth.T_wc[true_row], camera, max_range=settings.max_range)

    return grid_truth.score(cells, scene, T_sl, points(), band=(settings.band_low, settings.band_high)).to_dict()


def without_people(depth: np.ndarray, recording: Path, stamp: float) -> np.ndarray:
    """Remove the people from a depth image (H, W) [m] where a simulated recording shows them in the frame of this stamp [s].

    A foot is so near the floor behind it that its reading would count as of that floor, which it hides.
    """
    mask = recording / "moving" / f"{stamp:.6f}.png"
    return np.where(read_mask(mask, depth.shape), np.float32(np.nan), depth) if mask.is_file() else depth
