"""Open3D's recorder: camera_intrinsic.json, color/ and depth/ in millimetres, registered; no stamps."""

from pathlib import Path

from slamcli.datasets.calibration import find_calibration
from slamcli.datasets.readers import numbered
from slamcli.datasets.recorded import Recorded

INTRINSICS = "camera_intrinsic.json"
DEPTH_SCALE = 1000.0


def recognises(path: Path) -> bool:
    """Look for the recorder's file of intrinsics beside the two folders."""
    return (path / INTRINSICS).is_file() and numbered.recognises(path)


def read(path: Path) -> Recorded:
    """Pair images by number."""
    return numbered.of_folders(path, reader="open3d", calibration=find_calibration(path, (INTRINSICS,)), depth_scale=DEPTH_SCALE)
