"""Record3D's export: metadata.json, rgb/N.jpg and depth/N.exr in metres, a fraction of the pictures' size."""

from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import DEPTH_SUFFIXES, IMAGE_SUFFIXES, Folder, in_step, numbered
from slamcli.datasets.intrinsics import from_value
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.sources import ImageFiles
from slamcli.errors import SlamError
from slamcli.files import read_json

METRES = 1.0  # units of floating-point depth


def recognises(path: Path) -> bool:
    """Look for the description beside the folders of images."""
    return (path / "metadata.json").is_file() and (path / "rgb").is_dir() and (path / "depth").is_dir()


def read(path: Path) -> Recorded:
    """Pair images by number, which is also the place of their stamp."""
    about = read_json(path / "metadata.json")
    folder = Folder(path)
    colour, depth = numbered(folder, "rgb", IMAGE_SUFFIXES), numbered(folder, "depth", DEPTH_SUFFIXES)
    depth, said = in_step(list(colour), depth, path)
    if not any(number in depth for number in colour):
        raise SlamError(f"{path}: no image of rgb/ has the number of one of depth/")
    calibration = find_calibration(path)
    is_float = any(name.lower().endswith((".exr", ".npy", ".tiff", ".tif")) for name in depth.values())
    return Recorded(
        reader="record3d",
        root=path,
        colour=Stream(ImageFiles(path, list(colour.values())), stamps(about, list(colour)), str(path / "metadata.json")),
        depth=Stream(ImageFiles(path, [depth.get(number, "") for number in colour]), None, str(path)),
        calibration=calibration if calibration.values else intrinsics(about, path / "metadata.json"),
        is_paired=True,
        depth_scale=METRES if is_float else None,
        warnings=said,
    )


def intrinsics(about: dict[str, Any], source: Path) -> Calibration:
    """Read K, by columns, for pictures of w x h."""
    try:
        values = from_value({"k": about["K"]})
        size = {"width": int(about["w"]), "height": int(about["h"])}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SlamError(f"{source}: has no intrinsics K for pictures of w x h; is it of Record3D?") from error
    if not values:
        raise SlamError(f"{source}: K is no intrinsic matrix")
    return Calibration({**values, **size}, str(source))


def stamps(about: dict[str, Any], numbers: list[int]) -> np.ndarray | None:
    """Return the stamp of each number; from the frame rate where there is no list, None where there is neither."""
    listed, fps = about.get("frameTimestamps"), about.get("fps")
    try:
        if isinstance(listed, list) and listed:
            return np.array([float(listed[n]) if n < len(listed) else np.nan for n in numbers])
        return np.array(numbers, dtype=np.float64) / float(fps) if fps else None
    except (TypeError, ValueError, ZeroDivisionError):
        return None
