"""What a reader finds in a recording, before clocks are judged, images paired and calibrations completed."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamcli.datasets.calibration import Calibration
from slamcli.datasets.clock import Clock
from slamcli.datasets.sources import Images
from slamcli.errors import SlamError
from slamcli.formats.trajectory import read_tum
from slamcli.geometry import se3
from slamcli.schema import Trajectory

LISTED, BY_NUMBER, BY_NAME = (f"in the order of {what}" for what in ("the list", "their numbers", "their names"))
Truth = Callable[[Clock], Trajectory | None]


@dataclass(frozen=True)
class Stream:
    """Images in the order in which the recording has them, with the stamps written there."""

    images: Images
    stamp: np.ndarray | None = None  # (N,) float64 in any unit, or no clock at all; None = there are none
    where: str = ""  # names the list, folder or topic in warnings
    order: str = "in the order of the recording"  # that the images have where no clock tells it, for warnings

    def __len__(self) -> int:
        return len(self.images.names)


@dataclass(frozen=True)
class Recorded:
    """Colour and depth as a reader found them."""

    reader: str
    root: Path
    colour: Stream
    depth: Stream
    calibration: Calibration
    is_paired: bool = False  # row i of depth belongs to row i of colour, "" where there is none; else stamps decide
    depth_scale: float | None = None  # what this layout has where its calibration does not say it; None = it is measured
    truth: Truth | None = None
    warnings: list[str] = field(default_factory=list)


def truth_file(path: Path) -> Truth | None:
    """Return the truth of a TUM trajectory file, whose stamps are of the colour images' clock; None where there is no such file."""
    if not path.is_file():
        return None

    def read(clock: Clock) -> Trajectory | None:
        return in_seconds(read_tum(path), clock, str(path))

    return read


def poses_by_number(path: Path, files: dict[int, str], numbers: list[int | None]) -> np.ndarray:
    """Read one pose file of 4 x 4 for each number, (N, 4, 4), NaN where there is none or it cannot be read."""
    poses = np.full((len(numbers), 4, 4), np.nan)
    for row, number in enumerate(numbers):
        if number is not None and number in files:
            with contextlib.suppress(SlamError):
                poses[row] = read_matrices(path / files[number])[0]
    return poses


def truth_of_rows(T_wc: np.ndarray) -> Truth:
    """Return the truth as one pose for each row of colour, (N, 4, 4), not finite = unknown."""

    def read(clock: Clock) -> Trajectory | None:
        poses = T_wc[clock.row]
        is_known = np.isfinite(poses).all(axis=(1, 2))
        return Trajectory(stamp=clock.stamp[is_known], T_wc=poses[is_known]) if is_known.any() else None

    return read


def truth_when_asked(load: Callable[[], np.ndarray]) -> Truth:
    """Return the truth that `load` reads when somebody asks for it: one pose for each row of colour, (N, 4, 4), not finite = unknown."""
    return lambda clock: truth_of_rows(load())(clock)


def truth_of_columns(rows: np.ndarray) -> Truth:
    """Return the truth that stands beside the images in one list, (N, 8) stamp tx ty tz qx qy qz qw for each row of colour."""
    return truth_of_rows(se3.from_quaternion(rows[:, 1:4], rows[:, 4:8]))


def in_seconds(trajectory: Trajectory, clock: Clock, where: str) -> Trajectory:
    """Bring the stamps of a trajectory to the seconds of a list's clock."""
    if clock.seconds is None:
        raise SlamError(f"{where}: its stamps cannot be compared with those of the images, which are no clock")
    return Trajectory(stamp=clock.seconds(trajectory.stamp), T_wc=trajectory.T_wc)


def read_matrices(path: Path, *, per_row: int = 16) -> np.ndarray:
    """Read poses of 16 (or 12) numbers from a text file, (N, 4, 4) float64; SlamError where the numbers do not come out even."""
    from slamcli.datasets.lists import read_text

    try:
        numbers = np.array(read_text(path).replace(",", " ").split(), dtype=np.float64)
    except ValueError:
        raise SlamError(f"{path}: holds something else than numbers; expected poses of {per_row} numbers") from None
    if len(numbers) == 0 or len(numbers) % per_row:
        raise SlamError(f"{path}: {len(numbers)} numbers are no poses of {per_row}")
    poses = np.tile(np.eye(4), (len(numbers) // per_row, 1, 1))
    poses[:, : per_row // 4] = numbers.reshape(-1, per_row // 4, 4)
    return poses
