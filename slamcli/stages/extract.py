"""extract: images -> ORB features with depth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from slamcli import artifacts
from slamcli.config.options import Config, ExtractConfig
from slamcli.datasets import Dataset, depth_unit
from slamcli.datasets.recording import spread
from slamcli.depth import at_key_points, coarse_images, icp
from slamcli.errors import BadFrame, SlamError
from slamcli.geometry.camera import Camera
from slamcli.parallel import ordered_map
from slamcli.schema import CoarseDepth, Features, Flow
from slamcli.slam import doubt, stream_doubt
from slamcli.slam.doubt import Finding
from slamcli.slam.stream_doubt import Readings
from slamcli.stages.association_file import write_association
from slamcli.stages.camera_file import write_camera
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.vision import optical_flow, orb

COUNTED = 16  # depth images whose readings are counted to judge their unit


@dataclass(frozen=True)
class Frame:
    """What one frame gives."""

    points: orb.KeyPoints
    depth: np.ndarray  # (N,) float32 [m]
    slope: np.ndarray  # (N, 2) float32 [1/m/px] of the inverse of depth
    coarse: np.ndarray | None  # (V, U) uint16, None where there is no depth
    faults: list[str]  # why an image could not be used
    readings: Readings | None = None  # what its depth image holds
    counts: np.ndarray | None = None  # (65536,) of a few frames: readings of each raw value


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Detect ORB features in every colour frame and read their depth."""
    n = len(inputs.dataset)
    found = frames(inputs.dataset, cfg.extract, range(n), workers=tools.workers)
    return assemble(list(tools.progress(found, "extract", n)), inputs, out, cfg, tools)


def frames(dataset: Dataset, settings: ExtractConfig, rows: Sequence[int], *, workers: int) -> Iterator[Frame]:
    """Extract some frames, in order. No frame depends on another, so that they may be divided among processes."""
    return ordered_map(partial(_extract, dataset, settings), rows, workers=workers)


def assemble(found: list[Frame], inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Write what was found in each frame of the recording."""
    dataset, camera = inputs.dataset, inputs.dataset.camera
    for i, frame in enumerate(found):
        for fault in frame.faults:
            tools.warn(f"frame {i} skipped: {fault}" if len(frame.points) == 0 else f"frame {i} has no depth: {fault}")
    if not any(len(frame.points) for frame in found):
        blank = (
            f"{dataset.root}: no feature in any of the {len(dataset)} colour frames: are they blank? try: slamcli inspect {dataset.root}"
        )
        if not any(frame.coarse is not None and frame.coarse.any() for frame in found):
            raise SlamError(blank)
        tools.warn(f"{blank}; the camera can be tracked by the shape alone that depth shows")
    features = _table(dataset, camera, found, cfg.extract.scale)
    artifacts.save(features, out)
    artifacts.save(_coarse_table(camera, found), out)
    artifacts.save(_flow_table(dataset, camera, found, tools) if cfg.extract.flow else Flow(), out)
    write_association(out / "frames.txt", dataset, features.depth_stamp)
    write_camera(out, camera)
    doubts, n = _doubts(dataset, found, features), np.diff(features.offset)
    for one in doubts:
        tools.warn(one.text)
    return {
        "frames": len(dataset),
        "features": int(n.sum()),
        "features_per_frame": [int(n.min()), float(np.median(n)), int(n.max())],
        "with_depth": float(np.isfinite(features.depth).mean()) if len(features.depth) else 0.0,
        "frames_without_depth": int(np.isnan(features.depth_stamp).sum()),
        "bad_images": sum(len(frame.faults) for frame in found),
    } | doubt.to_summary(doubts)


def _doubts(dataset: Dataset, found: list[Frame], features: Features) -> list[Finding]:
    """Judge whether the images are what a camera sees."""
    counts = [frame.counts for frame in found if frame.counts is not None]
    coarse = [frame.coarse if frame.coarse is not None else np.zeros(0, np.uint16) for frame in found]
    return [
        *stream_doubt.about_readings([frame.readings for frame in found]),
        *(stream_doubt.about_unit(np.sum(counts, axis=0), depth_unit.counting_scale(dataset.camera.depth_scale)) if counts else []),
        *stream_doubt.about_motion(features.stamp, stream_doubt.same_pictures(features), stream_doubt.same_depth(coarse)),
    ]


def _extract(dataset: Dataset, settings: ExtractConfig, i: int) -> Frame:
    """Detect the features of frame i; an image that cannot be used gives none, or none with depth."""
    faults = []
    try:
        grey = dataset.grey(i)
    except BadFrame as error:
        return Frame(orb.no_key_points(), np.zeros(0, np.float32), np.zeros((0, 2), np.float32), None, [str(error)])
    points = orb.detect(grey, settings)
    try:
        depth = dataset.depth(i)
    except BadFrame as error:
        depth = None
        faults.append(str(error))
    if depth is None:
        nowhere = np.full(len(points), np.nan, np.float32)
        return Frame(points, nowhere, slope=np.zeros((len(points), 2), np.float32), coarse=None, faults=faults)
    read = at_key_points.depth_at(depth, points.xy, window=settings.depth_window)
    if settings.depth_jump:
        read = np.where(at_key_points.is_behind_outline(depth, points.xy, jump=settings.depth_jump), np.float32(np.nan), read)
    slope, readings = at_key_points.inverse_depth_slope(depth, points.xy), stream_doubt.look(depth)
    return Frame(points, read, slope, icp.coarsen(depth), faults, readings, _counts(dataset, depth, i))


def _counts(dataset: Dataset, depth: np.ndarray, i: int) -> np.ndarray | None:
    """Count the readings of each raw value in frame i's depth image, if it is one of those looked at."""
    if i not in spread(len(dataset), COUNTED):
        return None
    return depth_unit.counted_metres(depth, depth_unit.counting_scale(dataset.camera.depth_scale))


def _table(dataset: Dataset, camera: Camera, found: list[Frame], scale: float) -> Features:
    points = [frame.points for frame in found]
    raw = np.concatenate([p.xy for p in points])
    return Features(
        stamp=np.asarray(dataset.stamp, dtype=np.float64),
        depth_stamp=np.where([frame.coarse is not None for frame in found], dataset.depth_stamp, np.nan),
        offset=np.cumsum([0] + [len(p) for p in points], dtype=np.int64),
        xy=camera.undistort(raw).astype(np.float32),
        depth=np.concatenate([frame.depth for frame in found]),
        slope=np.concatenate([frame.slope for frame in found]),
        octave=np.concatenate([p.octave for p in points]),
        angle=np.concatenate([p.angle for p in points]),
        desc=np.concatenate([p.desc for p in points]),
        octave_scale=np.array(scale),
    )


def _coarse_table(camera: Camera, found: list[Frame]) -> CoarseDepth:
    return coarse_images.encode((frame.coarse for frame in found), icp.coarse_shape(camera))


def _flow_table(dataset: Dataset, camera: Camera, found: list[Frame], tools: Tools) -> Flow:
    """Follow the key points of every frame into the next one."""

    def follow(i: int) -> np.ndarray:
        xy, n = found[i].points.xy, len(found)
        if i + 1 == n or len(xy) == 0 or len(found[i + 1].points) == 0:
            return np.full((len(xy), 2), np.nan, np.float32)
        return optical_flow.follow(dataset.grey(i), dataset.grey(i + 1), xy)

    followed = ordered_map(follow, range(len(found)), workers=tools.workers)
    raw = np.concatenate(list(tools.progress(followed, "flow", len(found))))
    is_found = np.isfinite(raw[:, 0])
    raw[is_found] = camera.undistort(raw[is_found])
    return Flow(flow_xy=raw)
