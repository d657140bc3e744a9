"""Where a recording's intrinsics come from: the user, a file in its folder, a camera's name, or the known cameras of the TUM data set."""

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.cameras import FREIBURG, NOMINAL, freiburg_number, nominal
from slamcli.datasets.intrinsics import read_camera_file, read_intrinsics
from slamcli.errors import SlamError
from slamcli.geometry.camera import SHAPE_TOLERANCE, Camera
from slamcli.hints import hint

CAMERA_FILES = ("camera.toml", "camera.json")
# Files that hold intrinsics in public layouts and recorders, the most telling first.
INTRINSICS_FILES = (
    "camera_intrinsic.json", "cam_params.json", "camera_intrinsics.json", "intrinsics.json", "intrinsic.json", "calibration.json",
    "calibration.txt", "camera-intrinsics.txt", "camera_intrinsics.txt", "intrinsics.txt", "intrinsic.txt", "K.txt", "calib.txt",
    "cam_K.txt", "camera_matrix.csv", "camera_info.yaml", "calibration.yaml", "calib.yaml", "camera.yaml", "intrinsics.yaml",
)  # fmt: skip
NEEDED = ("fx", "fy", "cx", "cy")
CAMERA_KEYS = frozenset(field.name for field in fields(Camera))
DEFAULT_DEPTH_SCALE = 1000.0  # millimetres: what nearly all recorders write
UNLIKE = 0.15  # by which the shares of the principal point differ that no other size of the picture explains
POWER_OF_TWO = 0.1  # octaves within which a size is taken to be halved or doubled
OFF_CENTRE = 0.3  # share of a picture's side within which a principal point lies from the middle, if its size is right


@dataclass(frozen=True)
class Calibration:
    """What a recording says of its cameras."""

    values: dict[str, Any]  # keys of Camera; of width, height and depth_scale each may lack
    source: str = ""
    depth_values: dict[str, Any] | None = None  # intrinsics of a depth camera whose images are not registered to colour
    T_cd: np.ndarray | None = None  # (4, 4) depth camera to colour camera, None = where colour is
    warnings: tuple[str, ...] = ()

    def with_defaults(self, **values: Any) -> "Calibration":
        """Fill in what is not said."""
        return replace(self, values={**values, **self.values})


def find_calibration(root: Path, files: tuple[str, ...] = ()) -> Calibration:
    """Look for intrinsics in a recording's folder: a camera file of ours, the number in a TUM name, then `files` and the common ones.

    A camera file that has not all of fx, fy, cx and cy adds to what else is found.
    """
    there = [root / name for name in CAMERA_FILES if os.path.lexists(root / name)]  # a dead link is told of, not passed over
    if not there:
        return _found(root, files)
    values, depth, T_cd = read_camera_file(there[0])
    others = {} if all(key in values for key in NEEDED) else _found(root, files).values
    said = tuple(text for other in there[1:] if (text := _disagreement(there[0], values, other)))
    return Calibration({**others, **values}, str(there[0]), depth, T_cd, said)


def _disagreement(path: Path, values: dict[str, Any], other: Path) -> str:
    """Say what a second camera file has otherwise, "" where nothing or where it cannot be read."""
    try:
        second, _, _ = read_camera_file(other)
    except SlamError:
        return ""
    differing = [f"{key} {values[key]} and {second[key]}" for key in values if key in second and values[key] != second[key]]
    return f"{path} and {other.name} disagree ({', '.join(differing)}): {path.name} counts; delete the wrong one" if differing else ""


def _found(root: Path, files: tuple[str, ...]) -> Calibration:
    number = freiburg_number(root.resolve().name)
    if number:
        return Calibration(FREIBURG[number].to_dict(), f"calibration of freiburg{number}")
    for name in (*files, *INTRINSICS_FILES):
        if (root / name).is_file():
            values = read_intrinsics(root / name)
            if values:
                return Calibration(values, str(root / name))
    return Calibration({})


def find_camera(folder: Path, override: dict[str, Any] | None, image_size: tuple[int, int] | None) -> Camera:
    """Return the camera of a folder by what is in it; see `complete`."""
    return complete(find_calibration(folder).with_defaults(), folder, override=override, size=image_size)


def complete(
    calibration: Calibration,
    root: Path,
    *,
    override: dict[str, Any] | None,
    size: tuple[int, int] | None,
    name: str = "",
    depth_scale: float | None = None,
) -> Camera:
    """Make a camera of what a recording says, for pictures of its `size` (width, height), None = unknown.

    override : single keys replace what was found; without a calibration it must be complete, save for the image size
    name : of a known camera, whose nominal intrinsics replace those found
    depth_scale : taken where nothing says it
    """
    values, source = dict(calibration.values), calibration.source
    if name:
        if size is None:
            raise SlamError(f"{root}: no picture could be read, so the intrinsics of {name} are not known for its size")
        values = {**{k: v for k, v in values.items() if k == "depth_scale"}, **nominal(name, *size)}
        source = f"camera {name}"
    if override:
        values, source = {**values, **override}, f"{source} with camera override" if source else "camera override"
    is_known = all(key in CAMERA_KEYS for key in values)  # else the camera names the key at fault
    missing = [key for key in NEEDED if key not in values] if is_known else []
    if missing:
        told = source if str(root) in source else f"{root}: {source}"
        what = f"{root}: no calibration" if not calibration.source else f"{told}: the calibration is not whole"
        raise SlamError(
            f"{what}: {', '.join(missing)} {'are' if len(missing) > 1 else 'is'} missing; put them into a camera.toml {_place(root)}, or name the "
            f"camera: {hint().option('recording.known_camera')} {'|'.join(NOMINAL)}; a run takes {hint().setting(f'camera.{missing[0]}')} and so on, too"
        )
    if depth_scale is not None:
        values.setdefault("depth_scale", depth_scale)
    if size is not None and "width" not in values and "height" not in values and is_known:
        values = _sized(values, size, source)
    whole = {key: int(values[key]) for key in ("width", "height") if isinstance(values.get(key), float) and values[key].is_integer()}
    camera = Camera.from_dict({**values, **whole}, source=source if str(root) in source else f"{root}: {source}")
    return camera if size is None else fitted(camera, size, root)


def fitted(camera: Camera, size: tuple[int, int], root: Path) -> Camera:
    """Bring a calibration to the size of the pictures: scaled where the shape fits, turned where they stand upright."""
    if (camera.width, camera.height) == size:
        return camera
    for candidate in (camera, camera.turned()) if (camera.p1, camera.p2) == (0.0, 0.0) else (camera,):
        if abs(size[0] / candidate.width / (size[1] / candidate.height) - 1.0) <= SHAPE_TOLERANCE:
            return candidate.scaled(*size)
    raise SlamError(
        f"{root}: colour images are {size[0]} x {size[1]} px but the calibration is for {camera.width} x {camera.height}; "
        "give the calibration of these images"
    )


def _place(root: Path) -> str:
    return "in the folder" if root.is_dir() else "beside the file"


def _sized(values: dict[str, Any], size: tuple[int, int], source: str) -> dict[str, Any]:
    """Add the size that intrinsics are for: the pictures' own, or another one of that shape where the principal point is far off."""
    try:
        shares = np.array([float(values["cx"]) / size[0], float(values["cy"]) / size[1]])
    except (TypeError, ValueError):
        shares = np.array([0.5, 0.5])  # the camera says what is wrong with them
    factor = 0.5 / float(shares.mean()) if shares.mean() > 0 else 1.0
    if (np.abs(shares - 0.5) < OFF_CENTRE / 2).all() or abs(shares[0] / max(shares[1], 1e-9) - 1.0) > UNLIKE:
        return {**values, "width": size[0], "height": size[1]}
    octaves = float(np.log2(factor))
    step = 2.0 ** round(octaves) if abs(octaves - round(octaves)) < POWER_OF_TWO else factor
    return {**values, "width": round(size[0] / step), "height": round(size[1] / step)}
