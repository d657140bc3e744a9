"""densify: the key frames' depth images to one coloured cloud in the level frame."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.artifacts import save
from slamcli.calibration import rolling_shutter
from slamcli.config.options import DensifyConfig, SensorConfig
from slamcli.dense import voxel_cloud
from slamcli.depth import oriented_points
from slamcli.errors import BadFrame
from slamcli.formats.cloud import write_ply, write_ply_mesh
from slamcli.geometry.camera import Camera
from slamcli.navigation import floor
from slamcli.parallel import ordered_map
from slamcli.schema import Features, Map, Timing, Tracks, frame_poses

SAMPLES_APART = 0.75  # voxels from sample to sample of a near surface: denser ones gain nothing
FIRST_CAMERA = np.eye(4)  # the world is its frame; the level frame's origin is below it
GROUND_FRAMES = 40  # key frames, evenly spread, that are searched for the floor; more do not move it


def run(inputs: Any, out: Path, cfg: Any, tools: Any) -> dict:
    """Find the floor, join the key frames' depth, write `cloud.ply` (and `mesh.ply` where a surface was made) in the floor's frame."""
    camera, option = inputs.camera("loop"), cfg.densify
    poses = depth_poses(inputs)
    model_w = _model(camera, option)
    n_used = 0

    def frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Hand some of the depth images on to the search for the floor, so that they are decoded once."""
        nonlocal n_used
        every = -(-len(poses) // GROUND_FRAMES)
        timeline = tools.progress(poses, "densify")
        for view in views(inputs.dataset, camera, timeline, cfg.sensor, option, workers=tools.workers, warn=tools.warn):
            model_w.add(view.seen, view.rgb, view.T_wk)
            n_used += 1
            if n_used % every == 0:
                yield view.depth, view.T_wk

    ground = floor.find_ground(frames(), camera, T_wc=FIRST_CAMERA, settings=cfg.ground, rng=tools.rng())
    if not ground.is_found:
        tools.warn("no floor was found: the level frame is the first camera's, turned to z up")
    if option.method == "tsdf":
        cloud = model_w.mesh().moved(ground.T_lw)
        write_ply_mesh(out / "mesh.ply", cloud.xyz, cloud.triangle, cloud.rgb, cloud.normal)
    else:
        cloud = model_w.cloud(min_points=option.min_points, neighbours=option.neighbours, max_deviation=option.max_deviation)
        cloud = cloud.moved(ground.T_lw)
    if not len(cloud.xyz):
        tools.warn("the cloud is empty: no key frame has depth within densify.depth_max")
    write_ply(out / "cloud.ply", cloud.xyz, cloud.rgb, cloud.normal)
    save(ground, out)
    return {
        "frames": len(inputs.dataset),
        "key_frames": len(poses),
        "used": n_used,
        "points": len(cloud.xyz),
        "is_floor_found": bool(ground.is_found),
    }


def _model(camera: Camera, option: DensifyConfig) -> Any:
    if option.method == "tsdf":
        from slamcli.dense.tsdf import Volume

        return Volume(camera, voxel=option.voxel, depth_max=option.depth_max)
    return voxel_cloud.VoxelCloud(option.voxel)


def depth_poses(inputs: Any, *, frames: str = "key") -> list[tuple[int, np.ndarray]]:
    """Give frames' numbers and where the camera was, in the world frame, when their depth was measured; of map segment 0 alone.

    inputs : what a stage gets, or a RunDir
    frames : "key" frames, or "all" that have a pose
    """
    features, map_, when = inputs.load(Features, "extract"), inputs.load(Map, "loop"), inputs.load(Timing, "loop")
    T_wc = frame_poses(inputs.load(Tracks, "loop"), map_)
    is_main = map_.kf_segment == 0
    T_wc[map_.kf_frame[is_main]] = map_.T_wk[is_main]
    T_wd = rolling_shutter.depth_poses(features.stamp, features.depth_stamp + float(when.depth_delay), T_wc)
    chosen = map_.kf_frame[is_main] if frames == "key" else np.flatnonzero(np.isfinite(T_wd[:, 0, 0]))
    return [(int(frame), T_wd[frame]) for frame in chosen]


@dataclass(frozen=True)
class View:
    """What one key frame sees."""

    T_wk: np.ndarray  # (4, 4) camera to world
    depth: np.ndarray  # (H, W) float32 [m]
    seen: oriented_points.Surface
    rgb: np.ndarray  # (H, W, 3) uint8


def views(
    dataset: Any,
    camera: Camera,
    poses: Iterable[tuple[int, np.ndarray]],
    sensor: SensorConfig,
    option: DensifyConfig,
    *,
    workers: int = 1,
    warn: Callable[[str], None] = lambda message: None,
) -> Iterator[View]:
    """Read and clean frames, in order; one without depth, or that cannot be read, gives no view."""
    is_volume = option.method == "tsdf"

    def view(item: tuple[int, np.ndarray]) -> View | None:
        frame, T_wk = item
        try:
            depth = dataset.depth(frame, camera)
            if depth is None:
                return None
            seen = oriented_points.surface(
                depth,
                camera,
                settings=option,
                stride=1 if is_volume else option.stride,
                spacing=0.0 if is_volume else SAMPLES_APART * option.voxel,
                depth_min=sensor.depth_min,
                depth_max=min(sensor.depth_max, option.depth_max),
            )
            return View(T_wk, depth, seen, dataset.rgb(frame))
        except BadFrame as error:
            warn(str(error))
            return None

    return (found for found in ordered_map(view, poses, workers=workers) if found is not None)
