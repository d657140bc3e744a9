"""extract: images -> ORB features with depth."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType

import numpy as np

from slamcli import artifacts
from slamcli.config.options import Config, ExtractConfig
from slamcli.datasets import Dataset, depth_unit
from slamcli.datasets.recording import spread
from slamcli.depth import at_key_points, coarse_images, icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.errors import BadFrame, SlamError
from slamcli.geometry.camera import Camera
from slamcli.hints import hint
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
    coarse: bytes | None  # code of the coarse depth image, None where there is no depth
    faults: list[str]  # why an image could not be used
    readings: Readings | None = None  # what its depth image holds
    counts: np.ndarray | None = None  # (65536,) of a few frames: readings of each raw value


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Detect ORB features in every colour frame and read their depth."""
    n = len(inputs.dataset)
    found = frames(inputs.dataset, cfg.extract, range(n), workers=tools.workers)
    return assemble(tools.progress(found, "extract", n), inputs, out, cfg, tools)


def frames(dataset: Dataset, settings: ExtractConfig, rows: Sequence[int], *, workers: int) -> Iterator[Frame]:
    """Extract some frames, in order. No frame depends on another, so that they may be divided among processes."""
    return ordered_map(partial(_extract, dataset, settings), rows, workers=workers)


def assemble(found: Iterable[Frame], inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Write what was found in each frame of the recording, in order."""
    dataset, camera = inputs.dataset, inputs.dataset.camera
    with _Gathered(out, camera, cfg.extract) as gathered:
        for frame in found:
            gathered.add(frame)
        features, coarse = gathered.finish(dataset)
    n = np.diff(gathered.offset)
    for i, faults in enumerate(gathered.faults):
        for fault in faults:
            tools.warn(f"frame {i} skipped: {fault}" if n[i] == 0 else f"frame {i} has no depth: {fault}")
    if not n.any():
        blank = (
            f"{dataset.root}: no feature in any of the {len(dataset)} colour frames: are they blank? try: {hint().inspect(dataset.root)}"
        )
        images = CoarseImages(coarse)
        if not any(images[i].any() for i in range(len(images))):
            raise SlamError(blank)
        tools.warn(f"{blank}; the camera can be tracked by the shape alone that depth shows")
    artifacts.save(_flow_table(dataset, camera, gathered.raw_xy, tools) if cfg.extract.flow else Flow(), out)
    write_association(out / "frames.txt", dataset, features.depth_stamp)
    write_camera(out, camera)
    doubts = _doubts(dataset, gathered, features, CoarseImages(coarse))
    for one in doubts:
        tools.warn(one.text)
    return {
        "frames": len(dataset),
        "features": int(n.sum()),
        "features_per_frame": [int(n.min()), float(np.median(n)), int(n.max())],
        "with_depth": gathered.n_with_depth / max(1, int(n.sum())),
        "frames_without_depth": int(np.isnan(features.depth_stamp).sum()),
        "bad_images": sum(len(faults) for faults in gathered.faults),
    } | doubt.to_summary(doubts)


class _Gathered:
    """What all frames gave: written as it comes where it has rows for each feature, which of a long recording would fill the memory."""

    def __init__(self, out: Path, camera: Camera, settings: ExtractConfig) -> None:
        self._camera, self._settings = camera, settings
        self._no_depth = coarse_images.code_of(np.zeros(icp.coarse_shape(camera), np.uint16))
        with ExitStack() as opened:
            self._features = opened.enter_context(artifacts.Writer(Features, out, "xy", "depth", "slope", "octave", "angle", "desc"))
            self._coarse = opened.enter_context(artifacts.Writer(CoarseDepth, out, "coarse_code"))
            self._writers = opened.pop_all()
        self._coarse_offset = [0]
        self.offset = [0]
        self.n_with_depth = 0  # features
        self.has_depth: list[bool] = []
        self.faults: list[list[str]] = []
        self.readings: list[Readings | None] = []
        self.counts: list[np.ndarray] = []
        self.raw_xy: list[np.ndarray] = []  # (N, 2) px of each frame's key points, distorted, where they are to be followed

    def __enter__(self) -> "_Gathered":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._writers.close()

    def add(self, frame: Frame) -> None:
        """Add the next frame."""
        points = frame.points
        self._features.append(
            xy=self._camera.undistort(points.xy).astype(np.float32, copy=False),
            depth=frame.depth,
            slope=frame.slope,
            octave=points.octave,
            angle=points.angle,
            desc=points.desc,
        )
        code = self._no_depth if frame.coarse is None else frame.coarse
        self._coarse.append(coarse_code=np.frombuffer(code, dtype=np.uint8))
        self.offset.append(self.offset[-1] + len(points))
        self._coarse_offset.append(self._coarse_offset[-1] + len(code))
        self.n_with_depth += int(np.isfinite(frame.depth).sum())
        self.has_depth.append(frame.coarse is not None)
        self.faults.append(frame.faults)
        self.readings.append(frame.readings)
        if frame.counts is not None:
            self.counts.append(frame.counts)
        if self._settings.flow:
            self.raw_xy.append(points.xy)

    def finish(self, dataset: Dataset) -> tuple[Features, CoarseDepth]:
        """Complete what was written, and return it."""
        features = self._features.finish(
            stamp=np.asarray(dataset.stamp, dtype=np.float64),
            depth_stamp=np.where(self.has_depth, dataset.depth_stamp, np.nan),
            offset=np.array(self.offset, dtype=np.int64),
            octave_scale=np.array(self._settings.scale),
        )
        rows_and_columns = np.array(icp.coarse_shape(self._camera), dtype=np.int32)
        return features, self._coarse.finish(coarse_shape=rows_and_columns, coarse_offset=np.array(self._coarse_offset, dtype=np.int64))


def _doubts(dataset: Dataset, gathered: _Gathered, features: Features, coarse: CoarseImages) -> list[Finding]:
    """Judge whether the images are what a camera sees."""
    counts, scale = gathered.counts, depth_unit.counting_scale(dataset.camera.depth_scale)
    return [
        *stream_doubt.about_readings(gathered.readings),
        *(stream_doubt.about_unit(np.sum(counts, axis=0), scale) if counts else []),
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
        scale = np.cumprod([1.0] + [settings.scale] * (settings.levels - 1))[points.octave]
        is_behind = at_key_points.is_behind_outline(depth, points.xy, scale, jump=settings.depth_jump)
        read = np.where(is_behind, np.float32(np.nan), read)
    slope, readings = at_key_points.inverse_depth_slope(depth, points.xy), stream_doubt.look(depth)
    return Frame(points, read, slope, coarse_images.code_of(icp.coarsen(depth)), faults, readings, _counts(dataset, depth, i))


def _counts(dataset: Dataset, depth: np.ndarray, i: int) -> np.ndarray | None:
    """Count the readings of each raw value in frame i's depth image, if it is one of those looked at."""
    if i not in spread(len(dataset), COUNTED):
        return None
    return depth_unit.counted_metres(depth, depth_unit.counting_scale(dataset.camera.depth_scale))


def _flow_table(dataset: Dataset, camera: Camera, raw_xy: list[np.ndarray], tools: Tools) -> Flow:
    """Follow the key points (N, 2) [px] of every frame, as they are in its image, into the next one."""

    def follow(i: int) -> np.ndarray:
        xy, n = raw_xy[i], len(raw_xy)
        if i + 1 == n or len(xy) == 0 or len(raw_xy[i + 1]) == 0:
            return np.full((len(xy), 2), np.nan, np.float32)
        return optical_flow.follow(dataset.grey(i), dataset.grey(i + 1), xy)

    followed = ordered_map(follow, range(len(raw_xy)), workers=tools.workers)
    raw = np.concatenate(list(tools.progress(followed, "flow", len(raw_xy))))
    is_found = np.isfinite(raw[:, 0])
    raw[is_found] = camera.undistort(raw[is_found])
    return Flow(flow_xy=raw)
