"""Triangle meshes with coloured vertices, or with a texture, as glTF 2.0 binary (.glb) and Wavefront OBJ; `WRITERS` also knows PLY.

glTF has y up: the level frame's z becomes y. Its vertex colours are linear, ours sRGB. Specification: Khronos Group, glTF 2.0.
"""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from slamcli.files import whole, write_bytes
from slamcli.formats.cloud import write_ply_mesh

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5123, 5125, 5126
TRIANGLES = 4
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
JPEG_QUALITY = 92
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
UP = np.array([0.0, 1.0, 0.0], dtype=np.float32)  # normal of a vertex that has none: glTF asks for unit length


def write_glb(path: Path, xyz: np.ndarray, triangle: np.ndarray, rgb: np.ndarray, normal: np.ndarray) -> None:
    """Write a mesh as one binary glTF file.

    xyz, normal : (N, 3), z up; triangle : (M, 3) vertex rows; rgb : (N, 3) uint8, sRGB. The surface is shown in its colours, without light.
    """
    position = _y_up(xyz)
    parts = [
        _Part(position, ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC3", "min": _bound(position.min), "max": _bound(position.max)}),
        _Part(_unit(_y_up(normal)), ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC3"}),
        _Part(_linear_rgba(rgb), ARRAY_BUFFER, {"componentType": UNSIGNED_SHORT, "type": "VEC4", "normalized": True}),
        _Part(triangle.astype("<u4").reshape(-1), ELEMENT_ARRAY_BUFFER, {"componentType": UNSIGNED_INT, "type": "SCALAR"}),
    ]
    _write_glb(path, parts, {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, {})


def write_textured_glb(path: Path, xyz: np.ndarray, triangle: np.ndarray, normal: np.ndarray, uv: np.ndarray, picture: np.ndarray) -> None:
    """Write a mesh with a picture on it as one binary glTF file, the picture as JPEG within.

    xyz, normal : (N, 3), z up; triangle : (M, 3) vertex rows; uv : (M, 3, 2) in [0, 1], right and down; picture : (S, S, 3) uint8, sRGB
    """
    vertex, corner, welded = _welded(triangle, uv)
    position, jpeg = _y_up(xyz[vertex]), np.frombuffer(_jpeg(picture), dtype=np.uint8)
    parts = [
        _Part(position, ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC3", "min": _bound(position.min), "max": _bound(position.max)}),
        _Part(_unit(_y_up(normal[vertex])), ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC3"}),
        _Part(corner.astype("<f4"), ARRAY_BUFFER, {"componentType": FLOAT, "type": "VEC2"}),
        _Part(welded.astype("<u4").reshape(-1), ELEMENT_ARRAY_BUFFER, {"componentType": UNSIGNED_INT, "type": "SCALAR"}),
        _Part(jpeg, None, None),
    ]
    texture = {
        "images": [{"bufferView": len(parts) - 1, "mimeType": "image/jpeg"}],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}],
        "textures": [{"source": 0, "sampler": 0}],
    }
    _write_glb(path, parts, {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, texture)


class _Part(NamedTuple):
    """An array of a glTF file."""

    values: np.ndarray
    target: int | None  # what it is used for, None for an image
    kind: dict[str, Any] | None  # of its accessor, None for an image


def _write_glb(path: Path, parts: list[_Part], attributes: dict[str, int], texture: dict[str, Any]) -> None:
    """Write parts, among them the rows of vertices as the fourth, to a file with one mesh, in its colours without light."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at = 0
    for k, part in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": at, "byteLength": part.values.nbytes})
        if part.target is not None and part.kind is not None:
            views[-1]["target"] = part.target
            accessors.append({"bufferView": k, "count": len(part.values), **part.kind})
        at += part.values.nbytes + -part.values.nbytes % 4
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    if texture:
        surface["baseColorTexture"] = {"index": 0}
    about: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "slamcli"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0, "mode": TRIANGLES}]}],
        "materials": [{"pbrMetallicRoughness": surface, "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "buffers": [{"byteLength": at}], "bufferViews": views, "accessors": accessors, **texture,
    }  # fmt: skip
    head = json.dumps(about, separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    with whole(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(head) + 8 + at))
        file.write(struct.pack("<II", len(head), JSON_CHUNK) + head)
        file.write(struct.pack("<II", at, BINARY_CHUNK))
        for part in parts:
            file.write(part.values.tobytes() + bytes(-part.values.nbytes % 4))


def _welded(triangle: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make one vertex of all corners that share vertex and place in the picture: rows of old vertices, their uv, triangles of the new."""
    corner = np.column_stack([triangle.reshape(-1), uv.reshape(-1, 2)]).astype(np.float64)
    unique, row = np.unique(corner, axis=0, return_inverse=True)
    return unique[:, 0].astype(np.int64), unique[:, 1:], row.reshape(-1, 3)


def _jpeg(picture: np.ndarray) -> bytes:
    import cv2

    return cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


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


def write_textured_obj(path: Path, xyz: np.ndarray, triangle: np.ndarray, normal: np.ndarray, uv: np.ndarray, picture: np.ndarray) -> None:
    """Write a mesh with a picture on it as Wavefront OBJ, z up, and beside it a .mtl and a .jpg of the same name; as `write_textured_glb`."""
    material, image = path.with_suffix(".mtl"), path.with_suffix(".jpg")
    place, row = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
    text = io.BytesIO()
    text.write(f"# slamcli: metres, z up\nmtllib {material.name}\nusemtl surface\n".encode())
    np.savetxt(text, xyz, fmt="v %.5f %.5f %.5f")
    np.savetxt(text, np.column_stack([place[:, 0], 1.0 - place[:, 1]]), fmt="vt %.6f %.6f")  # OBJ counts upwards
    np.savetxt(text, normal, fmt="vn %.4f %.4f %.4f")
    vertex, texel = triangle.astype(np.int64) + 1, row.reshape(-1, 3) + 1
    np.savetxt(text, np.dstack([vertex, texel, vertex]).reshape(-1, 9), fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
    write_bytes(image, _jpeg(picture))
    write_bytes(material, f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {image.name}\n".encode())
    write_bytes(path, text.getvalue())


TEXTURE_WRITERS: dict[str, Callable[..., None]] = {".glb": write_textured_glb, ".obj": write_textured_obj}
WRITERS: dict[str, Callable[..., None]] = {".glb": write_glb, ".obj": write_obj, ".ply": write_ply_mesh}
