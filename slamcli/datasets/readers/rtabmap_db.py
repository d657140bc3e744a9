"""RTAB-Map's database: SQLite with compressed images, one row a node."""

import struct
from pathlib import Path

import numpy as np

from slamcli.datasets import images, png
from slamcli.datasets.calibration import Calibration
from slamcli.datasets.intrinsics import COEFFICIENTS
from slamcli.datasets.recorded import Recorded, Stream, truth_of_rows
from slamcli.datasets.sqlite import Blobs, query
from slamcli.errors import BadFrame, SlamError
from slamcli.formats import rvl
from slamcli.formats.image_header import JPEG_MAGIC
from slamcli.hints import hint

DEPTH_SCALE = 1000.0
RVL_MAGIC, INVERSE_MAGIC = b"DEPTHRVL", b"DEPTHINV"
HEADER = struct.Struct("<11i")  # three of the version, kind, width, height, numbers of K D R P, of the local transform
SQLITE_MAGIC = b"SQLite format 3\0"


def recognises(path: Path) -> bool:
    """Look for an SQLite file of that suffix that is no ROS 2 bag."""
    if not path.is_file() or path.suffix.lower() != ".db":
        return False
    with open(path, "rb") as file:
        return file.read(16) == SQLITE_MAGIC


def read(path: Path) -> Recorded:
    """List the nodes that have both images."""
    rows = query(
        path,
        "SELECT Node.id, stamp, length(Data.image), length(Data.depth), CASE WHEN length(ground_truth_pose) < 256 THEN ground_truth_pose END FROM Node JOIN Data ON Node.id = Data.id "
        "WHERE length(Data.image) > 0 AND length(Data.depth) > 0 ORDER BY Node.id",
        what="an RTAB-Map database",
    )
    if not rows:
        raise SlamError(f"{path}: holds no node with a colour and a depth image; record with Mem/ImageKept (rtabmap --params)")
    ids = [row[0] for row in rows]
    colour = Blobs(path, "SELECT image FROM Data WHERE id = ?", ids, [row[2] for row in rows], "image")
    depth = Blobs(path, "SELECT depth FROM Data WHERE id = ?", ids, [row[3] for row in rows], "depth", decode=decode_depth)
    poses = np.array([_pose(row[4]) for row in rows])
    return Recorded(
        reader="rtabmap_db",
        root=path,
        colour=Stream(colour, np.array([row[1] for row in rows], dtype=np.float64), str(path)),
        depth=Stream(depth, None, str(path)),
        calibration=_calibration(path, ids[0]),
        is_paired=True,
        depth_scale=DEPTH_SCALE,
        truth=truth_of_rows(poses) if np.isfinite(poses).any() else None,
    )


def decode_depth(data: bytes, name: str) -> bytes | np.ndarray:
    """Decode what RTAB-Map's Compression.cpp writes: PNG of 16 bits or of the bytes of floats, RVL, inverse depth."""
    if data.startswith(INVERSE_MAGIC) and len(data) > 16:
        a, b = struct.unpack("<ff", data[8:16])
        inner = decode_depth(data[16:], name)
        code = inner if isinstance(inner, np.ndarray) else images.decode_as_it_is(inner, name=name)
        if code.dtype != np.uint16:
            raise BadFrame(f"{name}: is damaged")
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(code > 0, np.float32(a) / (code.astype(np.float32) - np.float32(b)), np.float32(0)).astype(np.float32)
    if data.startswith(RVL_MAGIC) and len(data) > 16:
        try:
            return rvl.decode(data[16:], *struct.unpack("<II", data[8:16]))
        except SlamError as error:
            raise BadFrame(f"{name}: {error}") from error
    if data.startswith(png.MAGIC) and len(data) > 26 and data[25] == 6:  # RGBA: four bytes of a float
        image = images.decode_as_it_is(data, name=name)
        if image.ndim != 3 or image.shape[2] != 4 or image.dtype != np.uint8:
            raise BadFrame(f"{name}: is damaged")
        return np.ascontiguousarray(image).view(np.float32)[..., 0]
    if not data.startswith((png.MAGIC, JPEG_MAGIC)):
        raise BadFrame(f"{name}: is of a kind that is not known")
    return data


def _calibration(path: Path, node: int) -> Calibration:
    (data,) = query(path, f"SELECT calibration FROM Data WHERE id = {int(node)}", what="an RTAB-Map database")[0]
    broken = SlamError(
        f"{path}: the calibration of node {node} is missing or of a kind that is not known; put a camera's numbers by {hint().setting('camera.fx')}"
    )
    if data is None or len(data) < HEADER.size:
        return Calibration({})
    _, _, _, kind, width, height, n_k, n_d, n_r, n_p, n_local = HEADER.unpack_from(data)
    counts = (n_k, n_d, n_r, n_p)
    if kind != 0 or n_k != 9 or any(not 0 <= n <= 16 for n in counts) or len(data) < HEADER.size + 8 * sum(counts) + 4 * max(n_local, 0):
        raise broken
    k = np.frombuffer(data, "<f8", 9, HEADER.size)
    d = np.frombuffer(data, "<f8", n_d, HEADER.size + 72)
    values = {"fx": float(k[0]), "fy": float(k[4]), "cx": float(k[2]), "cy": float(k[5])}
    values |= {name: float(value) for name, value in zip(COEFFICIENTS, d, strict=False) if value != 0.0}
    size = {"width": width, "height": height} if width > 0 and height > 0 else {}
    return Calibration({**values, **size}, f"{path}: calibration of node {node}")


def _pose(data: bytes | None) -> np.ndarray:
    """Read a pose of 12 floats; NaN where there is none."""
    if data is None or len(data) != 48:
        return np.full((4, 4), np.nan)
    pose = np.eye(4)
    pose[:3] = np.frombuffer(data, "<f4").reshape(3, 4)
    return pose if pose[:3].any() else np.full((4, 4), np.nan)
