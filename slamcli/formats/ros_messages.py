"""The few ROS messages that a recording of images needs, read from their bytes: ROS 1's serialization and ROS 2's CDR.

Definitions: sensor_msgs Image, CompressedImage, CameraInfo; geometry_msgs Transform; tf2_msgs TFMessage; std_msgs Header.
"""

import struct
from dataclasses import dataclass

import numpy as np

from slamcli.errors import SlamError

MOST_TRANSFORMS = 10_000


@dataclass(frozen=True)
class Image:
    """sensor_msgs/Image, or CompressedImage where `encoding` is its format and width and height are 0."""

    frame_id: str
    encoding: str
    width: int
    height: int
    step: int  # bytes of a row
    is_bigendian: bool
    data: bytes


@dataclass(frozen=True)
class CameraInfo:
    """sensor_msgs/CameraInfo."""

    frame_id: str
    width: int
    height: int
    model: str
    d: list[float]
    k: list[float]  # 3 x 3, row by row
    p: list[float]  # 3 x 4, row by row: the projection of the rectified image; zeros where nobody set it


@dataclass(frozen=True)
class Transform:
    """One transform of tf: points of `child` to `parent`."""

    parent: str
    child: str
    T: np.ndarray  # (4, 4)


class Cursor:
    """Reads one value after another; in CDR each is aligned to its own size."""

    def __init__(self, data: bytes, *, is_cdr: bool) -> None:
        self.data, self.at, self.is_cdr = data, 4 if is_cdr else 0, is_cdr
        self.order = ">" if is_cdr and len(data) > 1 and not data[1] & 1 else "<"

    def number(self, kind: str) -> int | float:
        """Read one number; `kind` as in struct."""
        size = struct.calcsize(kind)
        self._align(size)
        (value,) = struct.unpack_from(self.order + kind, self.data, self.at)
        self.at += size
        return value

    def numbers(self, n: int) -> list[float]:
        """Read n doubles."""
        self._align(8)
        values = struct.unpack_from(f"{self.order}{n}d", self.data, self.at)
        self.at += 8 * n
        return list(values)

    def text(self) -> str:
        """Read a string."""
        raw = self.bytes()
        return raw.rstrip(b"\0").decode("utf-8", errors="replace")

    def bytes(self) -> bytes:
        """Read a sequence of bytes."""
        n = int(self.number("I"))
        if n > len(self.data) - self.at:
            raise struct.error("a sequence is longer than its message")
        value = self.data[self.at : self.at + n]
        self.at += n
        return value

    def header(self) -> tuple[int, str]:
        """Read a header: (stamp [ns], frame)."""
        if not self.is_cdr:
            self.number("I")
        seconds, nanoseconds = self.number("I"), self.number("I")
        return int(seconds) * 1_000_000_000 + int(nanoseconds), self.text()

    def _align(self, size: int) -> None:
        if self.is_cdr:
            self.at += -(self.at - 4) % size


def stamp(data: bytes, *, is_cdr: bool) -> int:
    """Read the stamp [ns] from the first bytes of a message with a header."""
    at = 4
    order = ">" if is_cdr and len(data) > 1 and not data[1] & 1 else "<"
    if len(data) < at + 8:
        raise SlamError("a message is cut off")
    seconds, nanoseconds = struct.unpack_from(order + "II", data, at)
    return seconds * 1_000_000_000 + nanoseconds


def image(data: bytes, *, is_cdr: bool, is_compressed: bool) -> Image:
    """Read an image message; SlamError where it is damaged."""
    try:
        cursor = Cursor(data, is_cdr=is_cdr)
        _, frame_id = cursor.header()
        if is_compressed:
            encoding = cursor.text()
            return Image(frame_id, encoding, 0, 0, 0, False, cursor.bytes())
        height, width, encoding = int(cursor.number("I")), int(cursor.number("I")), cursor.text()
        is_bigendian, step = bool(cursor.number("B")), int(cursor.number("I"))
        return Image(frame_id, encoding, width, height, step, is_bigendian, cursor.bytes())
    except struct.error as error:
        raise SlamError(f"an image message is cut off or of another kind ({error})") from error


def camera_info(data: bytes, *, is_cdr: bool) -> CameraInfo:
    """Read a CameraInfo message; SlamError where it is damaged."""
    try:
        cursor = Cursor(data, is_cdr=is_cdr)
        _, frame_id = cursor.header()
        height, width, model = int(cursor.number("I")), int(cursor.number("I")), cursor.text()
        n = int(cursor.number("I"))
        d = cursor.numbers(n) if n <= 64 else []
        k, _, p = cursor.numbers(9), cursor.numbers(9), cursor.numbers(12)
        return CameraInfo(frame_id, width, height, model, d, k, p)
    except struct.error as error:
        raise SlamError(f"a CameraInfo message is cut off or of another kind ({error})") from error


def transforms(data: bytes, *, is_cdr: bool) -> list[Transform]:
    """Read a TFMessage; SlamError where it is damaged."""
    try:
        cursor = Cursor(data, is_cdr=is_cdr)
        found = []
        for _ in range(min(int(cursor.number("I")), MOST_TRANSFORMS)):
            _, parent = cursor.header()
            child = cursor.text()
            found.append(Transform(parent.strip("/"), child.strip("/"), matrix(cursor.numbers(7))))
        return found
    except struct.error as error:
        raise SlamError(f"a tf message is cut off or of another kind ({error})") from error


def matrix(numbers: list[float]) -> np.ndarray:
    """Make (4, 4) of a translation and a quaternion x y z w."""
    from slamcli.geometry import se3

    quaternion = np.array([numbers[3:7]])
    if not np.isfinite(numbers).all() or np.linalg.norm(quaternion) < 1e-6:
        raise SlamError("a transform is no motion")
    return se3.from_quaternion(np.array([numbers[:3]]), quaternion)[0]
