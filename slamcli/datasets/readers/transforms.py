"""nerfstudio, Polycam and NeRFCapture: transforms.json with a depth image for each frame."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import files
from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import Folder, number_of
from slamcli.datasets.intrinsics import from_value
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.sources import ImageFiles
from slamcli.errors import SlamError
from slamcli.geometry import elementary

NAME = "transforms.json"
MAX_BYTES = 256 << 20
DEPTH_KEYS = ("depth_file_path", "depth_path", "depth_file")
TIME_KEYS = ("timestamp", "time", "stamp")


def recognises(path: Path) -> bool:
    """Look for the file by name."""
    return (path / NAME).is_file()


def read(path: Path) -> Recorded:
    """List the frames in the order of their stamps, else of their numbers, else of the file."""
    about = _load(path / NAME)
    frames = [frame for frame in about["frames"] if isinstance(frame, dict) and isinstance(frame.get("file_path"), str)]
    if not frames:
        raise SlamError(f"{path / NAME}: lists no frame")
    if not any(isinstance(frame.get(key), str) for frame in frames for key in DEPTH_KEYS):
        raise SlamError(f"{path / NAME}: its frames have no depth ({DEPTH_KEYS[0]}); a recording needs a depth image for each picture")
    folder = Folder(path)
    colour = [folder.find(frame["file_path"]) for frame in frames]
    depth = [_depth(folder, frame) for frame in frames]
    stamp = _stamps(frames)
    order = list(range(len(frames)))
    numbers = [number_of(name) for name in colour]
    warnings = []
    if stamp is None and all(n is not None for n in numbers) and len(set(numbers)) == len(numbers):
        order = sorted(order, key=lambda i: numbers[i] or 0)
        if order != list(range(len(frames))):
            warnings = [f"{path / NAME}: frames are not in the order of their numbers; sorted"]
    calibration = find_calibration(path)
    return Recorded(
        reader="transforms",
        root=path,
        colour=Stream(ImageFiles(path, [colour[i] for i in order]), stamp, str(path / NAME)),
        depth=Stream(ImageFiles(path, [depth[i] for i in order]), None, str(path / NAME)),
        calibration=calibration if calibration.values else Calibration(_intrinsics(about, frames), str(path / NAME)),
        is_paired=True,
        depth_scale=_depth_scale(about),
        warnings=warnings,
    )


def _load(path: Path) -> dict[str, Any]:
    try:
        about = json.loads(files.read_bytes(path, limit=MAX_BYTES).decode("utf-8-sig"))
    except (ValueError, RecursionError, OSError) as error:
        raise SlamError(f"{path}: cannot be parsed ({error})") from error
    if not isinstance(about, dict) or not isinstance(about.get("frames"), list):
        raise SlamError(f"{path}: has no list of frames")
    return about


def _depth(folder: Folder, frame: dict[str, Any]) -> str:
    name = next((frame[key] for key in DEPTH_KEYS if isinstance(frame.get(key), str)), "")
    return folder.find(name) if name else ""


def _stamps(frames: list[dict[str, Any]]) -> np.ndarray | None:
    for key in TIME_KEYS:
        values = [_number(frame.get(key)) for frame in frames]
        if all(value is not None for value in values):
            return np.array(values, dtype=np.float64)
    return None


def _intrinsics(about: dict[str, Any], frames: list[dict[str, Any]]) -> dict[str, Any]:
    """Read the file's intrinsics, or the median of those of its frames."""
    whole = from_value({key: value for key, value in about.items() if key != "frames"})
    if whole:
        return {key: value for key, value in whole.items() if key != "depth_scale"}
    each = [found for frame in frames if (found := from_value({**about, **frame}))]
    if not each:
        return _from_angle(about)
    middle = {key: float(np.median([found[key] for found in each])) for key in ("fx", "fy", "cx", "cy")}
    return {key: value for key, value in {**each[0], **middle}.items() if key != "depth_scale"}


def _number(value: Any) -> float | None:
    """Read a number, one in quotes too; None for anything else, and for what is not finite."""
    try:
        number = float(value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else np.nan
    except (ValueError, OverflowError):
        return None
    return number if np.isfinite(number) else None


def _from_angle(about: dict[str, Any]) -> dict[str, float]:
    """Work intrinsics out from the angle of view [rad] that Blender's scenes give, for pictures of w x h; {} where that is not all there."""
    angle, width, height = (_number(about.get(key)) for key in ("camera_angle_x", "w", "h"))
    if angle is None or width is None or height is None or not 0.0 < angle < np.pi:
        return {}
    fx = 0.5 * width / float(elementary.tan(0.5 * angle))
    upright = _number(about.get("camera_angle_y"))
    fy = 0.5 * height / float(elementary.tan(0.5 * upright)) if upright is not None and 0.0 < upright < np.pi else fx
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": 0.5 * (width - 1.0), "cy": 0.5 * (height - 1.0)}


def _depth_scale(about: dict[str, Any]) -> float:
    """Return units per metre: nerfstudio's default is millimetres; NeRFCapture says by how much whole numbers were divided."""
    for key in ("depth_unit_scale_factor", "integer_depth_scale"):
        value = _number(about.get(key))
        if value is not None and value > 0.0:
            return 1.0 / value
    return 1000.0
