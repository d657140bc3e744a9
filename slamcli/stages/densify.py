"""densify: the key frames' depth images to one coloured cloud in the level frame."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.artifacts import save
from slamcli.config.options import Config, DensifyConfig, SensorConfig
from slamcli.dense import exposure, voxel_cloud
from slamcli.depth import noise_model, oriented_points
from slamcli.formats.cloud import write_ply, write_ply_mesh
from slamcli.geometry.camera import Camera
from slamcli.navigation import floor
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.depth_frames import DepthFrames, PosedFrame, depth_poses, say_nothing

SAMPLES_APART = 0.75  # voxels from sample to sample of a near surface: denser ones gain nothing
FIRST_CAMERA = np.eye(4)  # the world is its frame; the level frame's origin is below it
COLOUR_STRIDE = 4  # [px] of the samples that tell exposures
GROUND_FRAMES = 40  # key frames, evenly spread, that are searched for the floor; more do not move it


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Find the floor, join the key frames' depth, write `cloud.ply` (and `mesh.ply` where a surface was made) in the floor's frame."""
    option, depths, poses = cfg.densify, DepthFrames.of(inputs, tools), depth_poses(inputs)
    camera = depths.camera
    model_w = _model(camera, option)
    colours = find_colours(depths, tools.progress(poses, "colours"), cfg.sensor, option) if option.even_colours else AS_RECORDED
    n_used = 0

    def frames() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Hand some of the depth images on to the search for the floor, so that they are decoded once."""
        nonlocal n_used
        every = -(-len(poses) // GROUND_FRAMES)
        for view in views(depths, tools.progress(poses, "densify"), cfg.sensor, option):
            model_w.add(view.seen, view.evened(colours), view.T_wk)
            n_used += 1
            if n_used % every == 0:
                yield view.depth, view.T_wk

    ground = floor.find_ground(
        frames(), camera, T_wc=FIRST_CAMERA, settings=cfg.ground, noise=noise_model.reading_noise(cfg.sensor), rng=tools.rng()
    )
    if not ground.is_found:
        tools.warn("no floor was found: the level frame is the first camera's, turned to z up")
    if option.method == "tsdf":
        cloud = model_w.mesh().moved(ground.T_lw)
        write_ply_mesh(out / "mesh.ply", cloud.xyz, cloud.triangle, cloud.rgb, cloud.normal)
    else:
        cloud = model_w.cloud(min_points=option.min_points, neighbours=option.neighbours, max_deviation=option.max_deviation)
        del model_w  # half of all that there is
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


@dataclass(frozen=True)
class Colours:
    """How key frames' colours are evened out."""

    log_gain: Mapping[int, np.ndarray]  # (3,) by frame
    shading: np.ndarray  # (H, W, 3) float32, factors against vignetting


AS_RECORDED = Colours({}, np.ones((1, 1, 3), np.float32))


@dataclass(frozen=True)
class KeyFrameView:
    """What one key frame sees."""

    frame: int
    T_wk: np.ndarray  # (4, 4) camera to world
    depth: np.ndarray  # (H, W) float32 [m]
    seen: oriented_points.Surface
    rgb: np.ndarray  # (H, W, 3) uint8

    def evened(self, colours: Colours) -> np.ndarray:
        """Return the colours (H, W, 3) uint8 evened out, as they are where this frame has no gain."""
        gain = colours.log_gain.get(self.frame)
        return self.rgb if gain is None else exposure.evened(self.rgb, gain, colours.shading)


def find_colours(depths: DepthFrames, poses: Iterable[PosedFrame], sensor: SensorConfig, option: DensifyConfig) -> Colours:
    """Find what evens out the key frames' colours; frames that cannot be read have no gain, and are told of when they are joined."""
    coarse = replace(option, method="voxel", stride=COLOUR_STRIDE)
    frame: list[int] = []

    def seen() -> Iterator[tuple[oriented_points.Surface, np.ndarray, np.ndarray]]:
        for view in views(replace(depths, warn=say_nothing), poses, sensor, coarse):
            frame.append(view.frame)
            yield view.seen, view.rgb, view.T_wk

    found = exposure.fit_evening(seen())
    return Colours(dict(zip(frame, found.gain, strict=True)), found.shading(depths.camera.height, depths.camera.width))


def views(depths: DepthFrames, poses: Iterable[PosedFrame], sensor: SensorConfig, option: DensifyConfig) -> Iterator[KeyFrameView]:
    """Read and clean frames, in order, without what moves; one without depth, or that cannot be read, gives no view."""
    is_volume = option.method == "tsdf"
    nearer = replace(sensor, depth_max=min(sensor.depth_max, option.depth_max))

    def look(frame: int, depth: np.ndarray, T_wk: np.ndarray) -> KeyFrameView:
        seen = oriented_points.surface(
            depth,
            depths.camera,
            settings=option,
            sensor=nearer,
            stride=1 if is_volume else option.stride,
            spacing=0.0 if is_volume else SAMPLES_APART * option.voxel,
        )
        return KeyFrameView(frame, T_wk, depth, seen, depths.dataset.rgb(frame))

    return depths.look_at(poses, look)
