"""LAS 1.4 and LAZ point clouds for surveyors' programs, through laspy: point format 7, colours of 16 bits, millimetres."""

import datetime
import io
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.errors import SlamError
from slamcli.files import write_bytes

SCALE = 0.001  # [m] of a unit
NO_DATE = datetime.date(1970, 1, 1)  # the same points give the same bytes on any day
TO_16_BITS = 257  # 255 becomes 65535


def write_las(path: Path, xyz: np.ndarray, rgb: np.ndarray | None = None, normal: np.ndarray | None = None) -> None:
    """Write points (N, 3) [m] and colours (N, 3) uint8 as .las or .laz; LAS has no field for normals, so they are left out."""
    laspy = _laspy()
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, SCALE)
    header.offsets = np.floor(xyz.min(axis=0)).astype(np.float64) if len(xyz) else np.zeros(3)
    header.generating_software, header.creation_date = "slamcli", NO_DATE
    points = laspy.LasData(header)
    points.x, points.y, points.z = np.asarray(xyz, dtype=np.float64).T
    if rgb is not None:
        points.red, points.green, points.blue = rgb.astype(np.uint16).T * TO_16_BITS
    data = io.BytesIO()
    points.write(data, do_compress=Path(path).suffix.lower() == ".laz")
    write_bytes(path, data.getvalue())


def _laspy() -> Any:
    try:
        import laspy
    except ImportError as error:
        raise SlamError("LAS files need one more package: pip install 'slamcli[survey]'") from error
    return laspy
