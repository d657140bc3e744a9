"""grid2d: the 2-D navigation grid, from the depth of well-spaced frames or from the octree."""

from pathlib import Path
from typing import Any

import numpy as np

from slamcli.artifacts import save
from slamcli.errors import BadFrame
from slamcli.formats import grid_map, octomap
from slamcli.navigation import grid
from slamcli.navigation.grid_evidence import View, look
from slamcli.parallel import ordered_map
from slamcli.schema import Features, Grid, Ground
from slamcli.stages.densify import depth_poses


def run(inputs: Any, out: Path, cfg: Any, tools: Any) -> dict:
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
    counts = {name: int((made.state == state).sum()) for name, state in (("occupied", grid.OCCUPIED), ("free", grid.FREE))}
    if not counts["free"]:
        tools.warn("the grid has no free cell: the floor was not seen")
    save(made, out)
    grid_map.write(out / "map.pgm", grid_map.GridMap(made.state, tuple(made.origin.tolist()), float(made.resolution)))
    rows, columns = made.state.shape
    return {**summary, "columns": columns, "rows": rows, **counts, "floor": bool(ground.is_found)}


def _from_depth(inputs: Any, T_lw: np.ndarray, cfg: Any, tools: Any) -> tuple[Grid, int]:
    option, camera = cfg.grid2d, inputs.camera("loop")
    rays = np.ascontiguousarray(camera.rays)
    has_depth = np.isfinite(inputs.load(Features, "extract").depth_stamp)
    poses = [(frame, T_lw @ T_wd) for frame, T_wd in depth_poses(inputs, frames="all") if has_depth[frame]]
    chosen = grid.spaced(np.array([T_ld for _, T_ld in poses]).reshape(-1, 4, 4), metres=option.spacing, degrees=option.spacing_deg)

    def view(row: int) -> View | None:
        frame, T_ld = poses[row]
        try:
            depth = inputs.dataset.depth(frame, camera)
        except BadFrame as error:
            tools.warn(str(error))
            return None
        return None if depth is None else look(depth, rays, T_ld, settings=option, sensor=cfg.sensor)

    found = ordered_map(view, tools.progress(chosen.tolist(), "grid2d"), workers=tools.workers)
    views = [one for one in found if one is not None]
    return grid.fuse(views, settings=option), len(views)
