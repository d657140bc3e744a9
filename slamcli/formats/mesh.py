"""Triangle meshes with coloured vertices as glTF 2.0 binary (.glb) and Wavefront OBJ; `WRITERS` also knows PLY.

glTF has y up: the level frame's z becomes y. Its vertex colours are linear, ours sRGB. Specification: Khronos Group, glTF 2.0.
"""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.files import whole, write_bytes
from slamcli.formats.cloud import write_ply_mesh

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5123, 5125, 5126
TRIANGLES = 4
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
UP = np.array([0.0, 1.0, 0.0], dtype=np.float32)  # normal of a vertex that has none: glTF asks for unit length


def write_glb(path: Path, xyz: np.ndarray, triangle: np.ndarray, rgb: np.ndarray, normal: np.ndarray) -> None:
    """Write a mesh as one binary glTF file.

    xyz, normal : (N, 3), z up; triangle : (M, 3) vertex rows; rgb : (N, 3) uint8, sRGB. The surface is shown in its colours, without light.
    """
    position = _y_up(xyz)
    buffers = [
        (position, ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC3", "min": _bound(position.min), "max": _bound(position.max)}),
        (_unit(_y_up(normal)), ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC3"}),
        (_linear_rgba(rgb), ARRAY_BUFFER, {"componentType": UNSIGNED_SHORT, "type": "VEC4", "normalized": True}),
        (triangle.astype("<u4").reshape(-1), ELEMENT_ARRAY_BUFFER, {"componentType": UNSIGNED_INT, "type": "SCALAR"}),
    ]
    views, accessors, at = [], [], 0
    for k, (values, target, kind) in enumerate(buffers):
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": target})
        accessors.append({"bufferView": k, "count": len(values), **kind})
        at += values.nbytes
    about: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "slamcli"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0, "mode": TRIANGLES}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "buffers": [{"byteLength": at}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    head = json.dumps(about, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    with whole(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(head) + 8 + at))
        file.write(struct.pack("<II", len(head), JSON_CHUNK) + head)
        file.write(struct.pack("<II", at, BINARY_CHUNK))
        for values, _, _ in buffers:
            file.write(values.tobytes())


def _bound(of: Callable[..., np.ndarray]) -> list[float]:
    return [float(value) for value in of(axis=0)]


def _y_up(vectors: np.ndarray) -> np.ndarray:
    x, y, z = np.asarray(vectors, dtype="<f4").T
    return np.ascontiguousarray(np.column_stack([x, z, -y]))


def _unit(normal: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(normal.astype(np.float64), axis=1, keepdims=True)
    return np.where(length > 1e-6, normal / np.maximum(length, 1e-6), UP).astype("<f4")


def _linear_rgba(rgb: np.ndarray) -> np.ndarray:
    """Convert sRGB (N, 3) uint8 to linear light (N, 4) in 16 bits, opaque: 8 bits would band in the dark."""
    value = np.arange(256) / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    out = np.full((len(rgb), 4), 65535, dtype="<u2")
    out[:, :3] = np.rint(linear * 65535.0).astype("<u2")[rgb]
    return out


def write_obj(path: Path, xyz: np.ndarray, triangle: np.ndarray, rgb: np.ndarray, normal: np.ndarray) -> None:
    """Write a mesh as Wavefront OBJ, z up, with colours behind the vertices' coordinates as MeshLab and Blender read them."""
    text = io.BytesIO()
    text.write(b"# slamcli: metres, z up; v x y z r g b\n")
    np.savetxt(text, np.column_stack([xyz, rgb / 255.0]), fmt="v %.5f %.5f %.5f %.4f %.4f %.4f")
    np.savetxt(text, normal, fmt="vn %.4f %.4f %.4f")
    a, b, c = (triangle.astype(np.int64) + 1).T
    np.savetxt(text, np.column_stack([a, a, b, b, c, c]), fmt="f %d//%d %d//%d %d//%d")
    write_bytes(path, text.getvalue())


WRITERS: dict[str, Callable[..., None]] = {".glb": write_glb, ".obj": write_obj, ".ply": write_ply_mesh}
