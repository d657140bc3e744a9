"""octree: depth images to occupied and free space in the level frame."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from slamcli.config.options import Config, OctreeConfig, SensorConfig
from slamcli.dense import change_detection
from slamcli.dense.occupancy import OccupancyMap, Scan
from slamcli.depth import oriented_points
from slamcli.formats import octomap
from slamcli.geometry import octree, se3
from slamcli.geometry.algebra import product
from slamcli.schema import Ground
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.depth_frames import DepthFrames, PosedFrame, depth_poses

RAYS_APART = 0.3  # cells from end point to end point on a near surface
ROUNDS = 2  # of asking the frames between: something may stand before what the first were asked about


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Insert depth images as scans, write `map.ot` and `map.bt`."""
    option, depths = cfg.octree, DepthFrames.of(inputs, tools)
    grid = OccupancyMap(option.resolution, hit=option.hit, miss=option.miss, clamp_min=option.clamp_min, clamp_max=option.clamp_max)
    n_scans = 0
    for poses in rounds(inputs, grid, option):
        for scan in scans(depths, tools.progress(poses, "octree"), cfg.sensor, option):
            grid.insert(scan.x, scan.origin, max_range=option.max_range, frame=scan.frame)
            n_scans += 1
    cells = grid.leaves()
    tree = octree.prune(cells)
    if not len(tree):
        tools.warn("the octree is empty: no frame has depth")
    n_nodes = octomap.write_ot(out / "map.ot", tree, parents=option.parents)
    octomap.write_bt(out / "map.bt", tree)
    n_occupied = int(cells.is_occupied().sum())
    return {
        "frames": len(inputs.dataset),
        "scans": n_scans,
        "occupied_cells": n_occupied,
        "free_cells": len(cells) - n_occupied,
        "leaves": len(tree),
        "nodes": n_nodes,
    }


def rounds(inputs: Inputs, grid: OccupancyMap, option: OctreeConfig) -> Iterator[list[PosedFrame]]:
    """Yield the frames to insert, each with its pose (4, 4) camera to level frame: the key frames, then twice those that the map is asked about."""
    T_lw = inputs.load(Ground, "densify").T_lw
    poses = [(frame, product(T_lw, T_wc)) for frame, T_wc in depth_poses(inputs, frames="all")]
    if option.frames == "all":
        yield poses
        return
    chosen = {frame for frame, _ in depth_poses(inputs)}
    n_key_frames = len(chosen)
    yield [pose for pose in poses if pose[0] in chosen]
    for _ in range(ROUNDS if option.frames == "auto" else 0):
        poses = [pose for pose in poses if pose[0] not in chosen]
        asked = change_detection.witnesses(grid, poses, inputs.camera("loop"), max_range=option.max_range, most=n_key_frames)
        chosen = {frame for frame, _ in asked}
        yield asked


def scans(depths: DepthFrames, poses: Iterable[PosedFrame], sensor: SensorConfig, option: OctreeConfig) -> Iterator[Scan]:
    """Read frames' depth, cleaned and without what moves, as scans in the frame that the poses lead to.

    poses : (frame, camera to that frame when its depth was measured); one without depth, or that cannot be read, gives no scan
    """

    def look(frame: int, depth: np.ndarray, T_lk: np.ndarray) -> Scan:
        seen = oriented_points.surface(
            depth,
            depths.camera,
            settings=option,
            sensor=sensor,
            stride=option.stride,
            spacing=RAYS_APART * option.resolution,
        )
        return Scan(se3.transform(T_lk, seen.xyz_c.astype(np.float64)), T_lk[:3, 3], frame)

    return depths.look_at(poses, look)
