"""grid2d: the 2-D navigation grid, from the depth of well-spaced frames or from the octree."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.artifacts import save
from slamcli.config.options import Config
from slamcli.depth import icp
from slamcli.formats import grid_map, octomap
from slamcli.formats.mask import read_mask
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.navigation import grid, own_body
from slamcli.navigation.driven import mark_driven
from slamcli.navigation.grid_evidence import View, look
from slamcli.navigation.robot_pose import planar_pose
from slamcli.navigation.terrain import Terrain
from slamcli.schema import FrameTimes, Grid, Ground, Map, Tracks, frame_poses
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.depth_frames import DepthFrames, PosedFrame, depth_poses
from slamcli.stages.moving_parts import MOVES, coarse_images

MOVED_ON = 0.2  # [s] after which what moves lets see another part of the floor: a quarter of a metre at a walk
BODY_VIEWS = 60  # spread over the drive, in which the robot's own body is looked for


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Write map.pgm, map.yaml and the Grid."""
    grid.check(cfg.grid2d)
    ground = inputs.load(Ground, "densify")
    if not ground.is_found:
        tools.warn("no floor was found: heights are measured from the first camera, so the grid is not fit to drive on")
    summary: dict[str, Any] = {"frames": len(inputs.dataset)}
    if cfg.grid2d.source == "octree":
        from slamcli.navigation.grid_from_octree import grid_from_octree

        made = grid_from_octree(octomap.read(inputs.path("octree", "map.ot")), settings=cfg.grid2d)
    else:
        made, summary["views"] = _from_depth(inputs, ground, cfg, tools)
    T_lc = product(ground.T_lw, frame_poses(inputs.load(Tracks, "loop"), inputs.load(Map, "loop")))
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


def _from_depth(inputs: Inputs, ground: Ground, cfg: Config, tools: Tools) -> tuple[Grid, int]:
    option, depths, T_lw = cfg.grid2d, DepthFrames.of(inputs, tools), ground.T_lw
    floor_height = option.band_low if ground.is_found else None
    rays = np.ascontiguousarray(depths.camera.rays)
    depth_stamp, moving = inputs.load(FrameTimes, "loop").depth_stamp, depths.moving.moving
    has_depth = np.isfinite(depth_stamp)
    poses = [(frame, product(T_lw, T_wd)) for frame, T_wd in depth_poses(inputs, frames="all") if has_depth[frame]]
    chosen = grid.spaced(np.array([T_ld for _, T_ld in poses]).reshape(-1, 4, 4), metres=option.spacing, degrees=option.spacing_deg)
    if len(moving):
        frames = np.array([frame for frame, _ in poses], dtype=np.int64)
        chosen = np.union1d(chosen, _past_what_moves(depth_stamp[frames], moving[frames].mean(axis=(1, 2))))

    is_left_out = _left_out(inputs, [poses[row] for row in chosen.tolist()], cfg, tools)

    n_views = 0

    def views(floor: Terrain) -> Iterator[View]:
        """Hand each view on at once: together their lines of sight would fill much memory."""
        nonlocal n_views
        n_views = 0

        def look_at(frame: int, depth: np.ndarray, T_ld: np.ndarray) -> View:
            if is_left_out is not None:
                depth = np.where(is_left_out, np.float32(np.nan), depth)
            return look(depth, rays, T_ld, settings=option, sensor=cfg.sensor, floor=floor)

        spaced = tools.progress([poses[row] for row in chosen.tolist()], "grid2d")
        for view in depths.look_at(spaced, look_at, floor=floor_height):
            n_views += 1
            yield view

    return grid.fuse_over_floor(views, settings=option), n_views


def _past_what_moves(stamp: np.ndarray, share: np.ndarray) -> np.ndarray:
    """List rows of frames some time apart in which something moves: what it hides in one, another shows, also while the camera rests.

    stamp : (N,) [s]; share : (N,) of the view that moves
    """
    chosen, last = list[int](), -np.inf
    for row in np.flatnonzero(share > MOVES).tolist():
        if stamp[row] - last >= MOVED_ON:
            chosen.append(row)
            last = stamp[row]
    return np.array(chosen, dtype=np.int64)


def _left_out(inputs: Inputs, poses: list[PosedFrame], cfg: Config, tools: Tools) -> np.ndarray | None:
    """Find the pixels (H, W) whose depth is not used: those that the user masks and those that show the robot itself; None = all are."""
    camera = inputs.camera("loop")
    shape = camera.height, camera.width
    out = np.zeros(shape, dtype=bool)
    if cfg.grid2d.mask:
        out |= read_mask(Path(cfg.grid2d.mask), shape)
    if cfg.grid2d.own_body:
        body = _own_body(inputs, poses, camera, cfg.grid2d.band_low)
        if body.any():
            tools.warn(f"{body.mean():.1%} of the picture shows the same near depth in every view, as the robot's own body does: left out")
        out |= body
    return out if out.any() else None


def _own_body(inputs: Inputs, poses: list[PosedFrame], camera: Camera, band_low: float) -> np.ndarray:
    chosen = [poses[k] for k in np.unique(np.linspace(0, len(poses) - 1, min(len(poses), BODY_VIEWS)).astype(int))] if poses else []
    units = coarse_images(inputs).of(frame for frame, _ in chosen)
    if not units.size:
        return np.zeros((camera.height, camera.width), dtype=bool)
    depth = np.where(units > 0, units * icp.UNIT, np.nan)
    T_lc = np.stack([T for _, T in chosen])
    side = camera.height // depth.shape[1]
    rays = camera.rays[side // 2 :: side, side // 2 :: side][: depth.shape[1], : depth.shape[2]].astype(np.float64)
    slope = np.einsum("nk,vuk->nvu", T_lc[:, 2, :2], rays) + T_lc[:, 2, 2, None, None]
    blocks = own_body.fixed_parts(depth, T_lc[:, 2, 3, None, None] + depth * slope, T_lc, band_low=band_low)
    return own_body.to_pixels(blocks, (camera.height, camera.width))
