"""COLMAP's sparse model, as text and as binary: cameras, images with their poses and key points, points with their tracks.

Poses are world to camera, quaternions w first. COLMAP's pixel (0, 0) is the corner of the top-left pixel, ours its centre: half a pixel
is added to the principal point and to key points. Layout: COLMAP's documentation, "Output Format", and its read_write_model.py.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli.errors import SlamError
from slamcli.files import write_bytes
from slamcli.geometry import se3
from slamcli.geometry.camera import EQUIDISTANT, Camera

HALF_PIXEL = 0.5
MODEL_ID = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
CAMERA_ID = 1
FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class SparseModel:
    """Images of one camera, and the points seen in them. P points, I images, O observations sorted by point."""

    camera: Camera
    name: list[str]  # (I,) of the image files
    T_wc: np.ndarray  # (I, 4, 4) camera to world
    xyz: np.ndarray  # (P, 3) m, world
    rgb: np.ndarray  # (P, 3) uint8
    error: np.ndarray  # (P,) px, mean reprojection error
    obs_point: np.ndarray  # (O,) row in xyz
    obs_image: np.ndarray  # (O,) row in name
    obs_xy: np.ndarray  # (O, 2) px in the raw image, column then row, pixel (0, 0) is the centre of the top-left pixel


def camera_model(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's name of a lens model and its parameters."""
    focal = [camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL]
    if camera.lens == EQUIDISTANT:
        return "OPENCV_FISHEYE", [*focal, camera.k1, camera.k2, camera.k3, camera.k4]
    if not camera.is_distorted:
        return "PINHOLE", focal
    lens = [camera.k1, camera.k2, camera.p1, camera.p2]
    if not camera.k3 and not camera.is_rational:
        return "OPENCV", [*focal, *lens]
    return "FULL_OPENCV", [*focal, *lens, camera.k3, camera.k4, camera.k5, camera.k6]


def write_text(folder: Path, model: SparseModel) -> list[Path]:
    """Write cameras.txt, images.txt and points3D.txt into an existing folder."""
    name, parameters = camera_model(model.camera)
    size = f"{model.camera.width} {model.camera.height}"
    cameras = f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n{CAMERA_ID} {name} {size} {_numbers(parameters)}\n"
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"]
    seen = _by_image(model)
    for i, (pose, file_name) in enumerate(zip(_poses(model), model.name, strict=True)):
        points = " ".join(f"{x:.3f} {y:.3f} {point + 1}" for (x, y), point in zip(*seen[i], strict=True))
        images.append(f"{i + 1} {_numbers(pose)} {CAMERA_ID} {file_name}\n{points}\n")
    points3d = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"]
    for p, track in enumerate(_tracks(model)):
        red, green, blue = model.rgb[p].tolist()
        ends = " ".join(f"{image + 1} {row}" for image, row in track)
        points3d.append(f"{p + 1} {_numbers(model.xyz[p])} {red} {green} {blue} {model.error[p]:.6g} {ends}\n")
    texts = (cameras, "".join(images), "".join(points3d))
    return [_write(folder / f"{file}.txt", text.encode()) for file, text in zip(FILES, texts, strict=True)]


def write_binary(folder: Path, model: SparseModel) -> list[Path]:
    """Write cameras.bin, images.bin and points3D.bin into an existing folder."""
    name, parameters = camera_model(model.camera)
    cameras = struct.pack("<QiiQQ", 1, CAMERA_ID, MODEL_ID[name], model.camera.width, model.camera.height)
    cameras += np.asarray(parameters, dtype="<f8").tobytes()
    images = [struct.pack("<Q", len(model.name))]
    seen = _by_image(model)
    row = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    for i, (pose, file_name) in enumerate(zip(_poses(model), model.name, strict=True)):
        xy, point = seen[i]
        rows = np.empty(len(xy), dtype=row)
        rows["xy"], rows["point"] = xy, point + 1
        images += [struct.pack("<i7di", i + 1, *pose, CAMERA_ID), file_name.encode() + b"\0", struct.pack("<Q", len(xy)), rows.tobytes()]
    points3d = [struct.pack("<Q", len(model.xyz))]
    for p, track in enumerate(_tracks(model)):
        points3d.append(struct.pack("<Q3d3BdQ", p + 1, *model.xyz[p], *model.rgb[p].tolist(), model.error[p], len(track)))
        points3d.append((np.asarray(track, dtype="<i4").reshape(-1, 2) + [[1, 0]]).astype("<i4").tobytes())
    contents = (cameras, b"".join(images), b"".join(points3d))
    return [_write(folder / f"{file}.bin", data) for file, data in zip(FILES, contents, strict=True)]


def _write(path: Path, data: bytes) -> Path:
    write_bytes(path, data)
    return path


def _poses(model: SparseModel) -> list[list[float]]:
    """Return qw qx qy qz tx ty tz of each image, world to camera."""
    if not np.isfinite(model.T_wc).all():
        raise SlamError("COLMAP: an image has no pose")
    T_cw = se3.inverse(model.T_wc).reshape(-1, 4, 4)
    x, y, z, w = se3.quaternion_xyzw(T_cw).reshape(-1, 4).T
    return np.column_stack([w, x, y, z, T_cw[:, :3, 3]]).tolist()


def _rows_in_image(model: SparseModel) -> np.ndarray:
    """Number each observation (O,) within its image, in the order of the observations."""
    order = np.argsort(model.obs_image, kind="stable")
    image = model.obs_image[order]
    first = np.searchsorted(image, image, side="left")
    row = np.empty(len(order), dtype=np.int64)
    row[order] = np.arange(len(order)) - first
    return row


def _by_image(model: SparseModel) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return each image's key points (N, 2) [px, COLMAP's] and their points (N,)."""
    order = np.argsort(model.obs_image, kind="stable")
    ends = np.searchsorted(model.obs_image[order], np.arange(len(model.name) + 1))
    xy = model.obs_xy[order].astype(np.float64) + HALF_PIXEL
    point = model.obs_point[order].astype(np.int64)
    return [(xy[a:b], point[a:b]) for a, b in zip(ends[:-1], ends[1:], strict=True)]


def _tracks(model: SparseModel) -> list[np.ndarray]:
    """Return the (image, key point) pairs of each point."""
    ends = np.searchsorted(model.obs_point, np.arange(len(model.xyz) + 1))
    pairs = np.column_stack([model.obs_image, _rows_in_image(model)])
    return [pairs[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]


def _numbers(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values))
