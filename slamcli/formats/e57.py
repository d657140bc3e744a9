"""E57 point clouds (ASTM E2807) for surveyors' programs, through pye57: single precision, colours of 8 bits.

The format wants an identifier and a time in each file, so two files of the same cloud differ in these.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.files import write_bytes

COORDINATES = ("cartesianX", "cartesianY", "cartesianZ")
COLOURS = ("colorRed", "colorGreen", "colorBlue")


def write_e57(path: Path, xyz: np.ndarray, rgb: np.ndarray | None = None, normal: np.ndarray | None = None) -> None:
    """Write points (N, 3) [m] and colours (N, 3) uint8; E57 has no standard field for normals, so they are left out."""
    pye57 = _pye57()
    if len(xyz) == 0:
        raise SlamError(f"{path}: an E57 file holds at least one point, and the cloud has none")
    columns = dict(zip(COORDINATES, np.ascontiguousarray(np.asarray(xyz, dtype=np.float64).T), strict=True))
    if rgb is not None:
        columns |= dict(zip(COLOURS, np.ascontiguousarray(rgb.T), strict=True))
    with tempfile.TemporaryDirectory(prefix="slamcli-e57-") as folder:  # the library writes under a name, and in pieces
        whole = Path(folder) / "cloud.e57"
        file = pye57.E57(str(whole), mode="w")
        file.write_scan_raw(columns, name="slamcli")
        file.close()
        write_bytes(path, whole.read_bytes())


def _pye57() -> Any:
    try:
        import pye57
    except ImportError as error:
        raise SlamError("E57 files need one more package: pip install 'slamcli[survey]'") from error
    return pye57
