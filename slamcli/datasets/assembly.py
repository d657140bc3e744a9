"""Make a recording of what a reader found: pair images, look at a few, complete the calibration."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.config.options import RecordingConfig
from slamcli.datasets import depth_unit, images
from slamcli.datasets.calibration import DEFAULT_DEPTH_SCALE, Calibration, complete
from slamcli.datasets.folder import IMAGE_SUFFIXES, Folder, subfolder
from slamcli.datasets.pairing import pair, select
from slamcli.datasets.recorded import Recorded
from slamcli.datasets.recording import Recording, spread
from slamcli.datasets.sources import ImageFiles, Images, count_missing, depth_pixels, picture
from slamcli.errors import BadFrame, SlamError
from slamcli.geometry import se3
from slamcli.geometry.camera import SHAPE_TOLERANCE, Camera
from slamcli.geometry.depth_registration import Registration

PROBED = 8  # images looked at when a recording is opened
LARGE = 1_100_000  # pixels of a picture from which it is reduced,
WORKING = 460_800  # to at most so many: 1.5 times 640 x 480
ROUGHER = 8.0  # times by which neighbouring readings differ more than with their bytes swapped, where they are swapped
STRETCHED = 257  # 8 bits stretched to 16 are multiples of this
MASK_FOLDERS = ("masks", "mask")
FLOAT_METRES = 100.0  # floating-point depth with a larger median is in millimetres


@dataclass(frozen=True)
class _Probe:
    """What a few depth images look like."""

    size: tuple[int, int] | None  # None = none could be read
    raw: list[np.ndarray]


def assemble(found: Recorded, *, name: str, camera: dict[str, Any] | None = None, options: RecordingConfig | None = None) -> Recording:
    """Make a recording; SlamError where a run would make no sense, `warnings` for what could be put right or had to be assumed."""
    options = options or RecordingConfig()
    pairs = select(pair(found, options.fps or None), options, found)
    colour_row = pairs.clock.row
    missing = count_missing(found.colour.images, colour_row, what="colour")
    missing += count_missing(found.depth.images, pairs.depth_row, what="depth")
    size = _colour_size(found.colour.images, colour_row)
    probe = _look_at_depth(found.depth.images, pairs.depth_row)
    scale, scale_said = _depth_scale(found, probe, camera)
    whole = complete(found.calibration, found.root, override=camera, size=size, name=options.known_camera, depth_scale=scale)
    size = size or (whole.width, whole.height)
    reduction = 1 if options.full_size else reduction_of(*size)
    working = whole.scaled(size[0] // reduction, size[1] // reduction) if reduction > 1 else whole
    registration, said = _registration(found.calibration, working, whole, probe, found, options.depth_camera)
    warnings = [*found.warnings, *found.calibration.warnings, *pairs.warnings, *missing, *scale_said, *said]
    if reduction > 1:
        warnings.append(
            f"{found.root}: pictures of {size[0]} x {size[1]} px are used at {working.width} x {working.height} (recording.full_size = true keeps them)"
        )
    return Recording(
        reader=found.reader,
        name=name,
        root=found.root,
        camera=working,
        stamp=pairs.clock.stamp,
        depth_stamp=pairs.depth_stamp,
        colour=found.colour.images,
        colour_row=colour_row,
        depth_images=found.depth.images,
        depth_row=pairs.depth_row,
        size=size,
        depth_size=probe.size,
        reduction=reduction,
        registration=registration,
        masks=_masks(found),
        warnings=[*warnings, *_doubts_about_depth(found, working, probe)],
        read_ground_truth=lambda: found.truth(pairs.clock) if found.truth is not None else None,
    )


def reduction_of(width: int, height: int) -> int:
    """Return by how many times pictures are made smaller: large ones cost time and add nothing to poses."""
    return 1 if width * height <= LARGE else math.ceil(math.sqrt(width * height / WORKING))


# what the images are


def _colour_size(source: Images, rows: np.ndarray) -> tuple[int, int] | None:
    """Find (width, height) of colour: what two images of a few agree on, so that one of another size costs no more than its frame."""
    sizes: list[tuple[int, int]] = []
    for i in spread(len(rows), PROBED):
        try:
            size = images.picture_size(picture(source, int(rows[i])), source.where(int(rows[i])))
        except BadFrame:
            continue
        if size in sizes:
            return size
        sizes.append(size)
    return sizes[0] if sizes else None


def _look_at_depth(source: Images, depth_row: np.ndarray) -> _Probe:
    """Decode a few depth images; SlamError where none of them is depth."""
    rows = depth_row[depth_row >= 0]
    raw: list[np.ndarray] = []
    errors: list[BadFrame] = []
    for i in spread(len(rows), PROBED):
        row = int(rows[i])
        try:
            found = depth_pixels(source, row)
        except BadFrame as error:
            errors.append(error)
            continue
        _check_bytes(found, source.where(row))
        raw.append(found)
    if errors and not raw:
        raise SlamError(str(errors[0]))
    if not raw:
        return _Probe(None, [])
    shape = max({r.shape for r in raw}, key=lambda shape: sum(r.shape == shape for r in raw))
    return _Probe((shape[1], shape[0]), [r for r in raw if r.shape == shape])


def _check_bytes(raw: np.ndarray, where: str) -> None:
    """Refuse 16-bit depth whose bytes were swapped, and 8 bits stretched to 16."""
    if raw.dtype != np.uint16:
        return
    some = raw[:: max(1, raw.shape[0] // 200)]
    if (some % STRETCHED == 0).all() and len(np.unique(some)) > 8:
        raise SlamError(f"{where}: has 8 bits a pixel, stretched to 16; depth must have 16 (was it saved as a picture for viewing?)")
    if _roughness(some) > ROUGHER * max(_roughness(some.byteswap()), 1.0):
        raise SlamError(f"{where}: the two bytes of each reading are swapped; write depth with the file format's own byte order")


def _roughness(raw: np.ndarray) -> float:
    """Return the median step between neighbouring readings that differ: half of them and more may be equal, whatever the order of bytes."""
    both = (raw[:, 1:] > 0) & (raw[:, :-1] > 0)
    step = np.abs(raw[:, 1:].astype(np.int32) - raw[:, :-1])[both]
    step = step[step > 0]
    return float(np.median(step)) if len(step) else 0.0


def _masks(found: Recorded) -> Images | None:
    """Find a folder of masks, images of the names that the colour images have; None where there is none."""
    home = subfolder(found.root, MASK_FOLDERS) if found.root.is_dir() else None
    if home is None:
        return None
    of_stem = {Path(name).stem: f"{home}/{name}" for name in Folder(found.root).files(home) if Path(name).suffix.lower() in IMAGE_SUFFIXES}
    return ImageFiles(found.root, [of_stem.get(Path(name).stem, "") for name in found.colour.images.names])


def _depth_scale(found: Recorded, probe: _Probe, override: dict[str, Any] | None) -> tuple[float, list[str]]:
    """Return the depth scale of a recording, and what must be said of it."""
    given = (override or {}).get("depth_scale", found.calibration.values.get("depth_scale", found.depth_scale))
    is_float = bool(probe.raw) and probe.raw[0].dtype != np.uint16
    if given is not None and not (is_float and given == found.depth_scale):
        return given, []
    if is_float:
        values = np.concatenate([r[np.isfinite(r) & (r > 0)].ravel()[::7] for r in probe.raw])
        if len(values) and np.median(values) > FLOAT_METRES:
            return 1000.0, [f"{found.root}: floating-point depth is in millimetres; read as such"]
        return 1.0, []
    measured, name = depth_unit.measure(depth_unit.counted(probe.raw)) if probe.raw else (None, "")
    if measured is not None:
        return measured, [
            f"{found.root}: no depth scale given; {measured:g} units per metre, as the steps between readings are those of a {name}"
        ]
    said = f"{found.root}: no depth scale given; {DEFAULT_DEPTH_SCALE:g} units per metre (millimetres) assumed"
    return DEFAULT_DEPTH_SCALE, [said]


def _registration(
    calibration: Calibration, working: Camera, whole: Camera, probe: _Probe, found: Recorded, named: str
) -> tuple[Registration | None, list[str]]:
    """Say how depth comes to colour: as it is or resized (None), or registered from a camera of its own."""
    if probe.size is None:
        return None, []
    if named:
        return _named_depth_camera(named, working, probe.size, found.root)
    if calibration.depth_values:
        source = f"{calibration.source or found.root}: depth"
        values = {"width": probe.size[0], "height": probe.size[1], **calibration.depth_values, "depth_scale": working.depth_scale}
        camera = Camera.from_dict(values, source=source)
        T_cd = np.eye(4) if calibration.T_cd is None else calibration.T_cd
        if (camera.width, camera.height) != probe.size:
            camera = camera.scaled(*probe.size)
        offset = 1000 * float(np.linalg.norm(T_cd[:3, 3], axis=-1))
        said = f"{found.root}: depth is registered to colour on reading (focal length {camera.fx:.1f} px, {offset:.0f} mm aside)"
        return Registration(camera, working, T_cd), [said]
    if abs(probe.size[0] / probe.size[1] / (whole.width / whole.height) - 1.0) > 2 * SHAPE_TOLERANCE:
        raise SlamError(
            f"{found.root}: depth images are {probe.size[0]} x {probe.size[1]} px, which is not the shape of the colour images "
            f"({whole.width} x {whole.height}), so they are not of one size of view; register depth to colour, or describe the depth camera in a table "
            "[depth] of camera.toml: fx fy cx cy and T_cd"
        )
    return None, []


def _named_depth_camera(named: str, working: Camera, size: tuple[int, int], root: Path) -> tuple[Registration, list[str]]:
    """Make the registration of `recording.depth_camera`."""
    try:
        fx, fy, cx, cy, *place = (float(word) for word in named.split())
        x, y, z, *turn = place
        rx, ry, rz = turn
    except ValueError:
        raise SlamError(f"recording.depth_camera = {named!r}: expected ten numbers, fx fy cx cy x y z rx ry rz [px, m, rad]") from None
    values = {"width": working.width, "height": working.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": working.depth_scale}
    camera = Camera.from_dict(values, source="recording.depth_camera")
    T_cd = se3.exp(np.array([0.0, 0.0, 0.0, rx, ry, rz]))
    T_cd[:3, 3] = x, y, z
    said = f"{root}: depth is registered to colour on reading (focal length {fx:.1f} px, {1000 * float(np.hypot(np.hypot(x, y), z)):.0f} mm aside)"
    return Registration(camera if (camera.width, camera.height) == size else camera.scaled(*size), working, T_cd), [said]


def _doubts_about_depth(found: Recorded, camera: Camera, probe: _Probe) -> list[str]:
    """Warn of depth images without a reading, and of a doubtful unit."""
    if not probe.raw:
        return []
    if not any(np.isfinite(camera.to_metres(raw)).any() for raw in probe.raw):
        return [f"{found.root}: the depth images looked at hold no reading"]
    if probe.raw[0].dtype != np.uint16:
        return []
    judged = depth_unit.judge(depth_unit.counted(probe.raw), camera.depth_scale)
    if judged.likely_scale is None:
        return []
    unit = f"{judged.likely_scale:g}{' (millimetres)' if judged.likely_scale == DEFAULT_DEPTH_SCALE else ''}"
    return [f"{found.root}: with depth_scale {camera.depth_scale:g} {judged.reason}; is camera.depth_scale = {unit} right?"]
