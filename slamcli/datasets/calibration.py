"""Where a recording's intrinsics come from: the user, a camera file in its folder, or the known cameras of the TUM data set."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from slamcli.errors import SlamError
from slamcli.geometry.camera import Camera

# J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012, calibration page of the data set. The depth images are
# already scaled, so the correction factors on that page must not be applied again; ORB-SLAM2 found another 4 % on freiburg2 (5208).
_VGA = {"width": 640, "height": 480}
FREIBURG = {
    1: Camera(**_VGA, fx=517.306408, fy=516.469215, cx=318.643040, cy=255.313989, k1=0.262383, k2=-0.953104, p1=-0.005358, p2=0.002628,
              k3=1.163314, depth_scale=5000.0),
    2: Camera(**_VGA, fx=520.908620, fy=521.007327, cx=325.141442, cy=249.701764, k1=0.231222, k2=-0.784899, p1=-0.003257, p2=-0.000105,
              k3=0.917205, depth_scale=5208.0),
    3: Camera(**_VGA, fx=535.4, fy=539.2, cx=320.1, cy=247.6, depth_scale=5000.0),
}  # fmt: skip
CAMERA_FILES = ("camera.toml", "camera.json")
MAX_BYTES = 1 << 20
KEYS = "width height fx fy cx cy k1 k2 p1 p2 k3 depth_scale inverse_depth_offset"


def freiburg_number(name: str) -> int | None:
    """Give n for names such as ``rgbd_dataset_freiburgN_desk``, ``freiburgN_desk`` and ``frN_desk``."""
    found = re.match(r"(?:rgbd_dataset_)?(?:freiburg|fr)([123])_", name)
    return int(found.group(1)) if found else None


def find_camera(folder: Path, override: dict[str, Any] | None, image_size: tuple[int, int] | None) -> Camera:
    """Give the camera of a recording.

    folder : a camera file in it counts more than the freiburg number in its name
    override : single keys replace what was found; without a calibration it must be complete, save for the image size
    image_size : (width, height) of the first readable colour image, used where nothing else says it
    """
    values, source = _recorded(folder)
    if override:
        values, source = {**values, **override}, "camera override" if not values else f"{source} with camera override"
    if not values:
        raise SlamError(
            f"{folder}: no calibration; put a camera.toml with the keys {KEYS} into the folder, or set camera.fx=... and the others"
        )
    if image_size is not None:
        values = {"width": image_size[0], "height": image_size[1], **values}
    whole = {key: int(values[key]) for key in ("width", "height") if isinstance(values.get(key), float) and values[key].is_integer()}
    return Camera.from_dict({**values, **whole}, source=source)


def _recorded(folder: Path) -> tuple[dict[str, Any], str]:
    for name in CAMERA_FILES:
        path = folder / name
        if path.is_file():
            return _read_camera_file(path), str(path)
    number = freiburg_number(folder.resolve().name)
    return (FREIBURG[number].to_dict(), f"calibration of freiburg{number}") if number else ({}, "")


def _read_camera_file(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SlamError(f"{path}: too large for a camera file")
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:  # both parsers' errors and wrong encoding are ValueErrors
        raise SlamError(f"{path}: cannot be parsed ({error})") from error
    if isinstance(values, dict) and set(values) == {"camera"}:
        values = values["camera"]
    if not isinstance(values, dict) or not values:
        raise SlamError(f"{path}: must be a table with the keys {KEYS}")
    return values
