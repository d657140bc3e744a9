"""grid2d: the 2-D navigation grid, from the depth of well-spaced frames or from the octree."""

from pathlib import Path
from typing import Any

import numpy as np

from slamcli.artifacts import save
from slamcli.config.options import Config
from slamcli.formats import grid_map, octomap
from slamcli.navigation import grid
from slamcli.navigation.driven import mark_driven
from slamcli.navigation.grid_evidence import View, look
from slamcli.navigation.robot_pose import planar_pose
from slamcli.schema import Features, Grid, Ground, Map, Moving, Tracks, frame_poses
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.depth_frames import depth_poses, read_depth


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Write map.pgm, map.yaml and the Grid before the decision rule."""
    grid.check(cfg.grid2d)
    ground = inputs.load(Ground, "densify")
    if not ground.is_found:
        tools.warn("no floor was found: heights are measured from the first camera, so the grid is not fit to drive on")
    summary: dict[str, Any] = {"frames": len(inputs.dataset)}
    if cfg.grid2d.source == "octree":
        from slamcli.navigation.grid_from_octree import grid_from_octree

        made = grid_from_octree(octomap.read(inputs.path("octree", "map.ot")), settings=cfg.grid2d)
    else:
        made, summary["views"] = _from_depth(inputs, ground.T_lw, cfg, tools)
    T_lc = ground.T_lw @ frame_poses(inputs.load(Tracks, "loop"), inputs.load(Map, "loop"))
    made = mark_driven(made, T_lc[:, :2, 3], settings=cfg.grid2d)
    counts = {name: int((made.state == state).sum()) for name, state in (("occupied", grid.OCCUPIED), ("free", grid.FREE))}
    if not counts["free"]:
        tools.warn("the grid has no free cell: the floor was not seen")
    save(made, out)
    has_pose = np.isfinite(T_lc[:, 0, 0])
    start = planar_pose(T_lc[has_pose][0]) if has_pose.any() else None
    grid_map.write(out / "map.pgm", grid_map.GridMap.of(made), start=start)
    rows, columns = made.state.shape
    return {**summary, "columns": columns, "rows": rows, **counts, "floor": bool(ground.is_found)}


def _from_depth(inputs: Inputs, T_lw: np.ndarray, cfg: Config, tools: Tools) -> tuple[Grid, int]:
    option, camera, moving = cfg.grid2d, inputs.camera("loop"), inputs.load(Moving, "loop")
    rays = np.ascontiguousarray(camera.rays)
    has_depth = np.isfinite(inputs.load(Features, "extract").depth_stamp)
    poses = [(frame, T_lw @ T_wd) for frame, T_wd in depth_poses(inputs, frames="all") if has_depth[frame]]
    chosen = grid.spaced(np.array([T_ld for _, T_ld in poses]).reshape(-1, 4, 4), metres=option.spacing, degrees=option.spacing_deg)

    def look_at(frame: int, depth: np.ndarray, T_ld: np.ndarray) -> View:
        return look(depth, rays, T_ld, settings=option, sensor=cfg.sensor)

    spaced = tools.progress([poses[row] for row in chosen.tolist()], "grid2d")
    views = list(read_depth(inputs.dataset, camera, spaced, look_at, moving=moving, workers=tools.workers, warn=tools.warn))
    return grid.fuse(views, settings=option), len(views)
