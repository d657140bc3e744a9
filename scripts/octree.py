#!/usr/bin/env python
"""Figures of the dense maps of finished runs: files, agreement, truth, and the octree against the OctoMap library.

    python scripts/octree.py runs/tum/fr1_xyz runs/tum/fr3_teddy runs/demo

* Files: cloud, octree and their ratio, as table 5 of Zhao et al. 2020 (there 3.217 % on average; file formats are not said).
* Agreement: replayed depth images, as OctoMap's eval_octree_accuracy (its paper: 97 to 99 %); of the key frames, which the tree was made
  from, and of frames between, which it has not seen.
* Truth: of a simulated recording, the distance of the cloud's points to the nearest true surface.
* Insertion: the same scans into the C++ library (pyoctomap) and into ours, in turns, one thread, fastest of several rounds.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from slamcli.console import table
from slamcli.dense import occupancy
from slamcli.dense.occupancy import OccupancyMap
from slamcli.errors import SlamError
from slamcli.evaluation import grid_truth, run_trajectories, trajectory_error
from slamcli.formats import cloud, octomap
from slamcli.geometry import se3
from slamcli.geometry.octree import Octree, expand, prune
from slamcli.parallel import one_thread_in_blas
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features, Ground, Map
from slamcli.stages.depth_frames import DepthFrames, depth_poses
from slamcli.stages.octree import scans

MODEL = {"hit": 0.7, "miss": 0.4, "clamp_min": 0.1192, "clamp_max": 0.971}  # OctoMap's own
RESOLUTION, MAX_RANGE = 0.05, 4.5  # [m] of the comparison with the library
MOST_SCANS = 40  # of a run that are inserted for the comparison, evenly spread
ROUNDS = 3  # the fastest counts: other processes only ever add time
BARE_POINT = 15  # bytes of a point without normal in a binary PLY


def files(run: RunDir) -> list[str]:
    """Sizes of the maps and their ratios."""
    size = {name: run.stage_path(*name.split("/")).stat().st_size for name in ("densify/cloud.ply", "octree/map.ot", "octree/map.bt")}
    ply, ot, bt = size.values()
    n = len(cloud.read_ply(run.stage_path("densify", "cloud.ply"))[0])
    bare = n * BARE_POINT
    shares = [f"{100 * part / whole:.3f} %" for whole in (ply, bare) for part in (bt, ot)]
    return [str(run.path), f"{ply / 1e6:.2f}", f"{bare / 1e6:.2f}", f"{ot / 1e6:.3f}", f"{bt / 1e6:.4f}", *shares]


def agreement(run: RunDir) -> list[str]:
    """Share of cells right in replayed key frames, and in frames half-way between them."""
    config, T_lw = run.config(), run.load(Ground, "densify").T_lw
    tree, kf = octomap.read(run.stage_path("octree", "map.bt")), run.load(Map, "loop").kf_frame
    T_wd = dict(depth_poses(run, frames="all"))
    out = [str(run.path)]
    for frames in (kf, np.setdiff1d((kf[:-1] + kf[1:]) // 2, kf)):
        poses = [(int(frame), T_lw @ T_wd[frame]) for frame in frames if frame in T_wd]
        found = occupancy.accuracy(
            tree, scans(DepthFrames(run.dataset(), run.camera()), poses, config.sensor, config.octree), max_range=config.octree.max_range
        )
        out += [f"{100 * found.share:.2f} %", str(found.correct + found.wrong), str(found.unknown)]
    return out


def truth(run: RunDir) -> list[str]:
    """Distances of the cloud to the scene it was rendered from, the trajectory aligned to the true one."""
    scene = grid_truth.read_scene(run.dataset().root / "scene.json")
    n_frames = len(run.load(Features, "extract").stamp)
    aligned = trajectory_error.ape(
        run_trajectories.stage_trajectory(run, "loop"), run_trajectories.ground_truth(run), n_frames=n_frames, name=""
    )
    xyz = cloud.read_ply(run.stage_path("densify", "cloud.ply"))[0].astype(np.float64)
    error = 1e3 * surface_distance(scene, se3.transform(aligned.T_gw @ se3.inverse(run.load(Ground, "densify").T_lw), xyz))
    quantiles = np.quantile(error, [0.5, 0.95, 0.99, 1.0])
    return [
        str(run.path),
        f"{np.sqrt(np.mean(aligned.error**2)) * 1e3:.1f}",
        f"{np.sqrt(np.mean(error**2)):.2f}",
        *(f"{value:.2f}" for value in quantiles),
    ]


def surface_distance(scene: grid_truth.TrueRoom, x: np.ndarray) -> np.ndarray:
    """Return the distance of points (N, 3) to the nearest surface of the room and the solids in it [m]."""
    out = np.abs(_box_distance(x - 0.5 * (scene.low + scene.high), 0.5 * (scene.high - scene.low)))
    for solid in scene.solids:
        local = x - np.array(solid["centre"])
        if solid["type"] == "box":
            c, s = np.cos(solid["yaw"]), np.sin(solid["yaw"])
            local = local @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            distance = _box_distance(local, 0.5 * np.array(solid["size"]))
        else:
            flat = np.column_stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]])
            distance = _box_distance(flat, np.array([solid["radius"], 0.5 * solid["height"]]))
        out = np.minimum(out, np.abs(distance))
    return out


def _box_distance(x: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Signed distance to a box about the origin, negative inside."""
    beyond = np.abs(x) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def insertion(run: RunDir, *, stride: int) -> list[list[str]]:
    """Times of both implementations on the same raw scans, and how their trees differ."""
    import pyoctomap

    T_lw, poses = run.load(Ground, "densify").T_lw, depth_poses(run)
    poses = [(frame, T_lw @ T_wk) for frame, T_wk in poses[:: -(-len(poses) // MOST_SCANS)]]
    raw = [raw_scan(run, frame, T_lk, stride) for frame, T_lk in poses]
    points = np.mean([len(x) for x, _ in raw])

    def ours(discretize: bool) -> Octree:
        grid = OccupancyMap(RESOLUTION, **MODEL)
        for x, origin in raw:
            grid.insert(x, origin, max_range=MAX_RANGE, discretize=discretize)
        return prune(grid.leaves())

    def theirs(discretize: bool) -> "pyoctomap.OcTree":
        tree = pyoctomap.OcTree(RESOLUTION)
        for x, origin in raw:
            tree.insertPointCloud(x.astype(np.float64), origin.astype(np.float64), max_range=MAX_RANGE, discretize=discretize)
        return tree

    rows = []
    for discretize in (False, True):
        times = dict.fromkeys((ours, theirs), np.inf)
        for _ in range(ROUNDS):
            for function in times:
                times[function] = min(times[function], cpu_seconds(lambda f=function, d=discretize: f(d)))
        per_scan = {function: 1e3 * seconds / len(raw) for function, seconds in times.items()}
        same, largest, n = difference(ours(discretize), theirs(discretize))
        rows.append(
            [
                str(run.path),
                "discretized" if discretize else "every point",
                f"{len(raw)}",
                f"{points:.0f}",
                f"{per_scan[theirs]:.1f}",
                f"{per_scan[ours]:.2f}",
                f"{per_scan[theirs] / per_scan[ours]:.1f}",
                str(n),
                f"{100 * same:.4f} %",
                f"{largest:.1e}",
            ]
        )
    return rows


def raw_scan(run: RunDir, frame: int, T_lk: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Return every stride-th reading of both directions as a point, uncleaned."""
    depth, rays = run.dataset().depth(frame)[::stride, ::stride], run.camera().rays[::stride, ::stride]
    seen = np.isfinite(depth)
    x_k = np.column_stack([rays[seen] * depth[seen][:, None], depth[seen]]).astype(np.float64)
    return se3.transform(T_lk, x_k).astype(np.float32), T_lk[:3, 3].astype(np.float32)


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of this thread."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


def difference(ours: Octree, theirs: "pyoctomap.OcTree") -> tuple[float, float, int]:  # noqa: F821
    """Return the share of cells of one class in both, the largest difference of log-odds, and the number of cells in either."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "theirs.ot"
        theirs.write(str(path))
        other = expand(octomap.read(path))
    own = expand(ours)
    _, at_own, at_other = np.intersect1d(own.key, other.key, return_indices=True)
    n = len(own) + len(other) - len(at_own)
    same = (own.is_occupied()[at_own] == other.is_occupied()[at_other]).sum() / n
    return same, float(np.abs(own.log_odds[at_own] - other.log_odds[at_other]).max()), n


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="finished run directories")
    parser.add_argument("--stride", type=int, default=2, help="of the pixels inserted into both trees [2]")
    parser.add_argument("--no-library", action="store_true", help="leave the comparison with the library out")
    options = parser.parse_args()
    runs = [RunDir.find(name) for name in options.runs]
    headings = ["run", "cloud.ply [MB]", "without normals", "map.ot [MB]", "map.bt [MB]", ".bt/.ply", ".ot/.ply", ".bt/bare", ".ot/bare"]
    print(table([headings, *map(files, runs)]), end="\n\n")
    print(table([["run", "key frames", "cells", "unknown", "between", "cells", "unknown"], *map(agreement, runs)]), end="\n\n")
    simulated = [run for run in runs if (run.dataset().root / "scene.json").is_file()]
    if simulated:
        print(table([["run", "APE [mm]", "RMS [mm]", "median", "95 %", "99 %", "max"], *map(truth, simulated)]), end="\n\n")
    if not options.no_library:
        headings = ["run", "scans", "number", "points", "C++ [ms]", "ours [ms]", "ratio", "cells", "same class", "largest difference"]
        with one_thread_in_blas():
            print(table([headings, *(row for run in runs for row in insertion(run, stride=options.stride))]))


if __name__ == "__main__":
    try:
        main()
    except SlamError as error:
        sys.exit(f"Error: {error}")
