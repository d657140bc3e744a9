"""glTF and OBJ files against trimesh, an independent reader."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from slamcli.formats import mesh

trimesh = pytest.importorskip("trimesh")

XYZ = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
TRIANGLE = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)  # outwards
RGB = np.array([[255, 0, 0], [0, 255, 0], [10, 20, 30], [255, 255, 255]], np.uint8)
NORMAL = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)  # the first is none


def glb(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and size % 4 == 0
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def test_trimesh_reads_the_same_surface_from_glb_with_y_up(tmp_path: Path) -> None:
    mesh.write_glb(tmp_path / "m.glb", XYZ, TRIANGLE, RGB, NORMAL)
    read = trimesh.load(tmp_path / "m.glb", process=False).to_geometry()
    np.testing.assert_allclose(read.vertices, XYZ[:, [0, 2, 1]] * [1, 1, -1])
    assert np.array_equal(read.faces, TRIANGLE)
    assert read.volume == pytest.approx(1.0)  # turned, not mirrored


def test_glb_keeps_to_the_standards_rules(tmp_path: Path) -> None:
    mesh.write_glb(tmp_path / "m.glb", XYZ, TRIANGLE, RGB, NORMAL)
    about, binary = glb(tmp_path / "m.glb")
    views, accessors = about["bufferViews"], about["accessors"]
    assert all(view["byteOffset"] % 4 == 0 for view in views) and len(binary) == about["buffers"][0]["byteLength"]
    assert accessors[0]["min"] == [0, 0, -2] and accessors[0]["max"] == [1, 3, 0]
    normal = np.frombuffer(binary, "<f4", 12, views[1]["byteOffset"]).reshape(4, 3)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-6)
    colour = np.frombuffer(binary, "<u2", 16, views[2]["byteOffset"]).reshape(4, 4)
    assert colour[:, 3].tolist() == [65535] * 4 and colour[0].tolist() == [65535, 0, 0, 65535]
    assert colour[2, 0] / 65535 == pytest.approx((10 / 255) / 12.92, abs=1e-4)  # sRGB to linear


def test_trimesh_reads_the_same_surface_and_colours_from_obj_and_ply(tmp_path: Path) -> None:
    for name in ("m.obj", "m.ply"):
        mesh.WRITERS[Path(name).suffix](tmp_path / name, XYZ, TRIANGLE, RGB, NORMAL)
        read = trimesh.load(tmp_path / name, process=False, maintain_order=True)
        np.testing.assert_allclose(read.vertices, XYZ, atol=1e-5)
        assert np.array_equal(read.faces, TRIANGLE)
        assert np.abs(read.visual.vertex_colors[:, :3].astype(int) - RGB).max() <= 1


def test_nothing_is_left_of_a_file_that_could_not_be_written(tmp_path: Path) -> None:
    with pytest.raises(IndexError):
        mesh.write_glb(tmp_path / "m.glb", XYZ, TRIANGLE, RGB.astype(int) + 300, NORMAL)
    assert not list(tmp_path.iterdir())


UV = np.array([[[0.1, 0.2], [0.3, 0.2], [0.1, 0.4]]] * 4, np.float32) + np.arange(4, dtype=np.float32)[:, None, None] * 0.15
PICTURE = np.kron(np.arange(64, dtype=np.uint8).reshape(8, 8, 1) * np.array([3, 1, 2], np.uint8), np.ones((8, 8, 1), np.uint8))


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_trimesh_reads_the_same_picture_at_every_corner(tmp_path: Path, ending: str) -> None:
    mesh.TEXTURE_WRITERS[ending](tmp_path / f"m{ending}", XYZ, TRIANGLE, NORMAL, UV, PICTURE)
    read = trimesh.load(tmp_path / f"m{ending}", process=False, force="mesh")
    corner = read.vertices[read.faces] if ending == ".obj" else read.vertices[read.faces][..., [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(corner, XYZ[TRIANGLE], atol=1e-5)
    uv = read.visual.uv[read.faces] * [1, -1] + [0, 1]  # trimesh counts upwards
    np.testing.assert_allclose(uv, UV, atol=1e-5)
    material = read.visual.material
    picture = np.asarray((material.baseColorTexture if ending == ".glb" else material.image).convert("RGB"))
    assert picture.shape == PICTURE.shape and np.abs(picture.astype(int) - PICTURE).mean() < 8


def test_textured_glb_keeps_to_the_standards_rules(tmp_path: Path) -> None:
    mesh.write_textured_glb(tmp_path / "m.glb", XYZ, TRIANGLE, NORMAL, UV, PICTURE)
    about, binary = glb(tmp_path / "m.glb")
    assert all(view["byteOffset"] % 4 == 0 for view in about["bufferViews"]) and len(binary) == about["buffers"][0]["byteLength"]
    image = about["bufferViews"][about["images"][0]["bufferView"]]
    assert "target" not in image and binary[image["byteOffset"] :][:3] == b"\xff\xd8\xff"
    assert about["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    assert about["accessors"][2]["count"] == len(np.unique(np.column_stack([TRIANGLE.ravel(), UV.reshape(-1, 2)]), axis=0))
