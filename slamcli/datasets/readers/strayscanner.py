"""StrayScanner: rgb.mp4, depth/000000.png in millimetres, confidence/, odometry.csv, camera_matrix.csv."""

from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration, find_calibration
from slamcli.datasets.folder import DEPTH_SUFFIXES, Folder, in_step, numbered
from slamcli.datasets.intrinsics import read_intrinsics
from slamcli.datasets.lists import columns, read_text, to_float
from slamcli.datasets.readers.numbered import with_confidence
from slamcli.datasets.recorded import Recorded, Stream
from slamcli.datasets.sources import ImageFiles
from slamcli.datasets.video import VideoFrames
from slamcli.errors import SlamError

DEPTH_SCALE = 1000.0
VIDEO, CALIBRATION = "rgb.mp4", "camera_matrix.csv"
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v")


def recognises(path: Path) -> bool:
    """Look for the table of poses beside the folder of depth images."""
    return (path / "odometry.csv").is_file() and (path / "depth").is_dir()


def read(path: Path) -> Recorded:
    """Pair frame N of the video with depth image N and row N of the table."""
    video = VideoFrames(_video(path))
    numbers = list(range(len(video.names)))
    stamp, focal = _table(path / "odometry.csv", len(numbers))
    depth, shifted = in_step(numbers, numbered(Folder(path), "depth", DEPTH_SUFFIXES), path)
    source, said = with_confidence(path, Folder(path), ImageFiles(path, [depth.get(n, "") for n in numbers]), numbers)
    calibration = find_calibration(path)
    if focal is not None:
        calibration = Calibration(focal, str(path / "odometry.csv"))
    elif not calibration.values and (path / CALIBRATION).is_file():
        calibration = Calibration(read_intrinsics(path / CALIBRATION), str(path / CALIBRATION))
    return Recorded(
        reader="strayscanner",
        root=path,
        colour=Stream(video, stamp, str(path / "odometry.csv")),
        depth=Stream(source, None, str(path)),
        calibration=calibration,
        is_paired=True,
        depth_scale=DEPTH_SCALE,
        warnings=shifted + said,
    )


def _video(path: Path) -> Path:
    """Find the video by its name, else the only one that is there; SlamError where there is none."""
    if (path / VIDEO).is_file():
        return path / VIDEO
    videos = [path / name for name in Folder(path).files() if name.lower().endswith(VIDEO_SUFFIXES)]
    if len(videos) != 1:
        raise SlamError(f"{path / VIDEO}: is not there, so the recording has no colour; copy it from the phone again")
    return videos[0]


def _table(path: Path, n: int) -> tuple[np.ndarray, dict[str, float] | None]:
    """Read the stamps (n,) of n frames, NaN where the table has none, and the median intrinsics where newer versions write them.

    A row is of the frame that its column `frame` names, else of the frame in its place.
    """
    lines = read_text(path).splitlines()
    heading = [name.lower() for name in columns(lines[0])] if lines else []
    if "timestamp" not in heading:
        raise SlamError(f"{path}: has no column timestamp; is it of StrayScanner?")
    rows = np.array([row for line in lines[1:] if len(row := [to_float(t) for t in columns(line)]) == len(heading)])
    if len(rows) == 0:
        raise SlamError(f"{path}: holds no row")
    names = ("fx", "fy", "cx", "cy")
    focal = None
    if all(name in heading for name in names):
        focal = {name: float(np.nanmedian(rows[:, heading.index(name)])) for name in names}
    frame = rows[:, heading.index("frame")] if "frame" in heading else np.arange(len(rows), dtype=np.float64)
    if not (np.isfinite(frame).all() and len(np.unique(frame)) == len(frame) and (frame == np.floor(frame)).all()):
        frame = np.arange(len(rows), dtype=np.float64)
    stamp, is_here = np.full(n, np.nan), (frame >= 0) & (frame < n)
    stamp[frame[is_here].astype(np.int64)] = rows[is_here, heading.index("timestamp")]
    return stamp, focal
