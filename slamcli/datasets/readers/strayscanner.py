"""StrayScanner: rgb.mp4, depth/000000.png in millimetres, confidence/, odometry.csv, camera_matrix.csv."""

from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import DEPTH_SUFFIXES, Folder, numbered
from slamcli.datasets.intrinsics import read_intrinsics
from slamcli.datasets.lists import columns, read_text, to_float
from slamcli.datasets.readers.numbered import with_confidence
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.sources import ImageFiles
from slamcli.datasets.video import VideoFrames
from slamcli.errors import SlamError

DEPTH_SCALE = 1000.0
VIDEO = "rgb.mp4"


def recognises(path: Path) -> bool:
    """Look for the table of poses beside the folder of depth images."""
    return (path / "odometry.csv").is_file() and (path / "depth").is_dir()


def read(path: Path) -> Recorded:
    """Pair frame N of the video with depth image N and row N of the table."""
    if not (path / VIDEO).is_file():
        raise SlamError(f"{path / VIDEO}: is not there, so the recording has no colour; copy it from the phone again")
    video = VideoFrames(path / VIDEO)
    stamp, focal = _table(path / "odometry.csv", len(video.names))
    depth = numbered(Folder(path), "depth", DEPTH_SUFFIXES)
    numbers = list(range(len(video.names)))
    source, said = with_confidence(path, Folder(path), ImageFiles(path, [depth.get(n, "") for n in numbers]), numbers)
    calibration = find_calibration(path)
    if focal is not None:
        calibration = Calibration(focal, str(path / "odometry.csv"))
    elif not calibration.values:
        calibration = Calibration(read_intrinsics(path / "camera_matrix.csv"), str(path / "camera_matrix.csv"))
    if len(stamp) < len(numbers):
        stamp = np.concatenate([stamp, np.full(len(numbers) - len(stamp), np.nan)])
    return Recorded(
        reader="strayscanner",
        root=path,
        colour=Stream(video, stamp, str(path / "odometry.csv")),
        depth=Stream(source, None, str(path)),
        calibration=calibration,
        is_paired=True,
        depth_scale=DEPTH_SCALE,
        warnings=said,
    )


def _table(path: Path, n: int) -> tuple[np.ndarray, dict[str, float] | None]:
    """Read the stamps of n frames, and the median intrinsics where newer versions write them."""
    lines = read_text(path).splitlines()
    heading = [name.lower() for name in columns(lines[0])] if lines else []
    if "timestamp" not in heading:
        raise SlamError(f"{path}: has no column timestamp; is it of StrayScanner?")
    rows = np.array([row for line in lines[1:] if len(row := [to_float(t) for t in columns(line)]) == len(heading)])
    if len(rows) == 0:
        raise SlamError(f"{path}: holds no row")
    rows = rows[:n]
    names = ("fx", "fy", "cx", "cy")
    focal = None
    if all(name in heading for name in names):
        focal = {name: float(np.nanmedian(rows[:, heading.index(name)])) for name in names}
    return rows[:, heading.index("timestamp")], focal
