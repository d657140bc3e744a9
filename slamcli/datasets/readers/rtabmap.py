"""RTAB-Map's export: rgb/1.jpg, depth/1.png, calib/1.yaml, and its poses file for stamps."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import Folder, number_of
from slamcli.datasets.intrinsics import read_intrinsics
from slamcli.datasets.lists import columns, data_lines, to_float
from slamcli.datasets.readers import numbered
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.errors import SlamError

CALIBRATIONS = "calib"
LOOKED_AT = 30  # files of intrinsics, of which the middle counts: a phone's focal length breathes
DEPTH_SCALE = 1000.0


def recognises(path: Path) -> bool:
    """Look for a file of intrinsics for each image."""
    return (path / CALIBRATIONS).is_dir() and numbered.recognises(path)


def read(path: Path) -> Recorded:
    """Pair images by number; the poses file tells each number's stamp."""
    calibration = find_calibration(path)
    if not calibration.values:
        calibration = _calibration(path)
    found = numbered.of_folders(path, reader="rtabmap", calibration=calibration, depth_scale=DEPTH_SCALE)
    stamp = _stamps(path, found)
    return found if stamp is None else replace(found, colour=Stream(found.colour.images, stamp, str(path)))


def _calibration(path: Path) -> Calibration:
    files = [name for name in Folder(path).files(CALIBRATIONS) if name.endswith((".yaml", ".yml"))]
    values = [read_intrinsics(path / CALIBRATIONS / name) for name in files[:: max(1, len(files) // LOOKED_AT)]]
    values = [value for value in values if value]
    if not values:
        raise SlamError(f"{path / CALIBRATIONS}: holds no intrinsics; put a camera.toml into {path}")
    numeric = {key: float(np.median([value[key] for value in values])) for key in ("fx", "fy", "cx", "cy")}
    return Calibration({**values[0], **numeric}, str(path / CALIBRATIONS))


def _stamps(path: Path, found: Recorded) -> np.ndarray | None:
    """Read ``stamp x y z qx qy qz qw id`` of a poses file; None where there is none that names images."""
    for file in sorted(path.glob("*poses*.txt")):
        rows = [[to_float(token) for token in columns(line)] for _, line in data_lines(file)]
        of = {int(row[8]): row[0] for row in rows if len(row) == 9 and np.isfinite(row).all()}
        numbers = [number_of(name) for name in found.colour.images.names]
        if of:
            return np.array([of.get(-1 if number is None else number, np.nan) for number in numbers])
    return None
