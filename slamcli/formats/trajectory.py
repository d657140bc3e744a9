"""Trajectory files: TUM (read and write), KITTI and CSV (write).

TUM, one pose a line: ``stamp tx ty tz qx qy qz qw``, camera to world, `#` starts a comment, commas and tabs may separate.
KITTI, one pose a line: the upper 3 x 4 of the camera-to-world matrix row by row, without a stamp.
CSV: a line of names, then the columns of TUM with commas between them.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.schema import Trajectory

MAX_BYTES = 1 << 30  # some 10 million poses; a larger file is not a trajectory
COLUMNS = 8
SHORTEST = 1e-12  # squared length of a quaternion
FARTHEST = 1e15  # m, s


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory, sorted by stamp; of poses with the same stamp the first one counts.

    Raises SlamError, naming file and line, for what is not a trajectory: wrong number of columns, words or NaN among the numbers, a
    quaternion of length 0, or no pose at all.
    """
    path = Path(path)
    rows = np.array([_parse(path, number, line) for number, line in _data_lines(path)])
    if len(rows) == 0:
        raise SlamError(f"{path}: holds no pose; expected lines 'stamp tx ty tz qx qy qz qw'")
    stamp, first = np.unique(rows[:, 0], return_index=True)
    return Trajectory(stamp=stamp, T_wc=se3.from_quaternion(rows[first, 1:4], rows[first, 4:8]))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory: stamps to the microsecond, positions to the nanometre."""
    files.write_text(path, "# timestamp tx ty tz qx qy qz qw\n" + _lines(trajectory, between=" "))


def write_csv(path: str | Path, trajectory: Trajectory) -> None:
    """Write a table for spreadsheets and pandas, in the precision of `write_tum`."""
    files.write_text(path, "timestamp,tx,ty,tz,qx,qy,qz,qw\n" + _lines(trajectory, between=","))


def _lines(trajectory: Trajectory, *, between: str) -> str:
    quaternion = se3.quaternion_xyzw(trajectory.T_wc).reshape(-1, 4)
    rows = np.column_stack([trajectory.stamp, trajectory.T_wc[:, :3, 3], quaternion])
    return "".join(between.join([f"{row[0]:.6f}", *(f"{value:.9f}" for value in row[1:])]) + "\n" for row in rows)


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI trajectory, one line a pose in the order of the stamps."""
    rows = trajectory.T_wc[:, :3, :].reshape(-1, 12)
    files.write_text(path, "".join(" ".join(f"{value:.9e}" for value in row) + "\n" for row in rows))


def writer(name: str) -> Callable[[str | Path, Trajectory], None]:
    """Return the function that writes one of `TRAJECTORY_FORMATS`."""
    write: Callable[[str | Path, Trajectory], None] = globals()[f"write_{name}"]
    return write


def _data_lines(path: Path) -> list[tuple[int, str]]:
    """Return (line number, text) of the lines that hold data."""
    try:
        text = files.read_bytes(path, limit=MAX_BYTES).decode("utf-8", errors="replace")
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    lines = enumerate(text.replace("\ufeff", "").splitlines(), start=1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def _parse(path: Path, number: int, line: str) -> list[float]:
    tokens = line.replace(",", " ").split()
    if len(tokens) != COLUMNS:
        raise SlamError(f"{path}:{number}: {len(tokens)} columns instead of the {COLUMNS} of 'stamp tx ty tz qx qy qz qw'")
    try:
        row = [float(token) for token in tokens]
    except ValueError:
        raise SlamError(f"{path}:{number}: not a number in {line.strip()[:80]!r}") from None
    if not np.isfinite(row).all():
        raise SlamError(f"{path}:{number}: NaN or infinite; leave out poses that are not known")
    if not SHORTEST < sum(q * q for q in row[4:]) < 1.0 / SHORTEST:
        raise SlamError(f"{path}:{number}: the quaternion has length 0, or none that can be told")
    if max(abs(x) for x in row[:4]) > FARTHEST:
        raise SlamError(f"{path}:{number}: {line.strip()[:80]!r} holds a stamp or a place that no camera can have")
    return row
