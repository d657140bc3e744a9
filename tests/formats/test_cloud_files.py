import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.errors import SlamError
from slamcli.formats import cloud

Points = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture
def points() -> Points:
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return rng.normal(size=(500, 3)).astype(np.float32), rng.integers(0, 256, (500, 3), dtype=np.uint8), normal.astype(np.float32)


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
@pytest.mark.parametrize("n", [0, 1, 500])
def test_reading_gives_back_what_was_written(points: Points, suffix: str, n: int, tmp_path: Path) -> None:
    xyz, rgb, normal = (column[:n] for column in points)
    path = tmp_path / f"cloud.{suffix}"
    for colour in (rgb, None):
        for direction in (normal, None):
            cloud.write(path, xyz, colour, direction)
            for found, expected in zip(cloud.read(path), (xyz, colour, direction), strict=True):
                assert found is None if expected is None else np.array_equal(found, expected)


def test_a_ply_file_is_its_header_and_packed_records(points: Points, tmp_path: Path) -> None:
    cloud.write_ply(tmp_path / "cloud.ply", points[0], points[1])
    data = (tmp_path / "cloud.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    assert head.decode().split("\n")[:4] == ["ply", "format binary_little_endian 1.0", "element vertex 500", "property float x"]
    assert "property uchar blue" in head.decode()
    assert len(body) == 500 * 15


def test_open3d_reads_our_files_and_we_read_its_own(points: Points, tmp_path: Path) -> None:
    from slamcli.open3d_loader import load_open3d

    o3d, (xyz, rgb, normal) = load_open3d(), points
    for suffix in ("ply", "pcd"):
        cloud.write(tmp_path / f"ours.{suffix}", xyz, rgb, normal)
        theirs = o3d.io.read_point_cloud(str(tmp_path / f"ours.{suffix}"))
        np.testing.assert_allclose(np.asarray(theirs.points), xyz, atol=1e-6)
        np.testing.assert_allclose(np.asarray(theirs.colors) * 255, rgb, atol=1e-6)
        np.testing.assert_allclose(np.asarray(theirs.normals), normal, atol=1e-6)
        for is_text in (False, True):
            path = tmp_path / f"theirs{is_text}.{suffix}"
            o3d.io.write_point_cloud(str(path), theirs, write_ascii=is_text)
            found = cloud.read(path)
            np.testing.assert_allclose(found[0], xyz, atol=1e-5)
            assert np.array_equal(found[1], rgb)
            np.testing.assert_allclose(found[2], normal, atol=1e-5)


def test_open3d_reads_our_meshes(points: Points, tmp_path: Path) -> None:
    from slamcli.open3d_loader import load_open3d

    triangle = np.random.default_rng(0).permutation(498).reshape(-1, 3).astype(np.int32)
    cloud.write_ply_mesh(tmp_path / "mesh.ply", points[0], triangle, points[1], points[2])
    theirs = load_open3d().io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    assert np.array_equal(np.asarray(theirs.triangles), triangle)
    np.testing.assert_allclose(np.asarray(theirs.vertices), points[0], atol=1e-6)
    assert np.array_equal(cloud.read(tmp_path / "mesh.ply")[0], points[0])


def test_big_endian_ply_and_other_number_types_are_read(tmp_path: Path) -> None:
    header = "ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
    body = np.array([[1, 2, 3], [4, 5, 6]], dtype=">f8").tobytes()
    (tmp_path / "cloud.ply").write_bytes(header.encode() + b"end_header\n" + body)
    assert cloud.read(tmp_path / "cloud.ply")[0].tolist() == [[1, 2, 3], [4, 5, 6]]


HEAD = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PCD = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.ply", b"", "not a PLY file"),
        ("a.ply", b"\x00" * 100_000, "not a PLY file"),
        ("a.ply", b"ply\n" + b"comment x\n" * 20_000, "not a PLY file"),
        ("a.ply", HEAD.replace(b"ascii", b"secret"), "'secret'"),
        ("a.ply", HEAD.replace(b"vertex 1", b"vertex -1"), "'-1'"),
        ("a.ply", HEAD.replace(b"vertex 1", b"vertex 99999999999"), "'99999999999'"),
        ("a.ply", HEAD.replace(b"vertex 1", b"face 1"), "first element"),
        ("a.ply", HEAD.replace(b"float x", b"list uchar int x"), "cannot be read"),
        ("a.ply", HEAD.replace(b"float y", b"float x"), "field twice"),
        ("a.ply", HEAD.replace(b"property float z\n", b""), "no x, y and z"),
        ("a.ply", HEAD + b"1 2", "cut off"),
        ("a.ply", HEAD + b"1 2 three", "not a number"),
        ("a.ply", HEAD + b"1 2 nan", "not finite"),
        ("a.ply", HEAD.replace(b"ascii", b"binary_little_endian").replace(b"vertex 1", b"vertex 500000000"), "cut off"),
        ("a.pcd", b"FIELDS x y z\n", "not a PCD file"),
        ("a.pcd", PCD.replace(b"FIELDS x y z", b"FIELDS"), "do not describe"),
        ("a.pcd", PCD.replace(b"COUNT 1 1 1", b"COUNT 1 1 9"), "do not describe"),
        ("a.pcd", PCD.replace(b"TYPE F F F", b"TYPE F F Q"), "not known"),
        ("a.pcd", PCD.replace(b"SIZE 4 4 4", b"SIZE 4 4 5"), "not known"),
        ("a.pcd", PCD.replace(b"DATA ascii", b"DATA binary_compressed"), "binary_compressed"),
        ("a.pcd", PCD.replace(b"POINTS 1", b"POINTS 900000000").replace(b"ascii", b"binary"), "cut off"),
        ("a.pcd", PCD.replace(b"POINTS 1\n", b""), "number of points"),
        ("a.obj", b"", r"\.ply or \.pcd"),
    ],
)
def test_damaged_files_give_one_line_and_little_memory(name: str, data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    with pytest.raises(SlamError, match=message) as error:
        cloud.read(tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "\n" not in str(error.value) and name in str(error.value)
    assert peak < 20 * len(data) + 1_000_000


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=80), st.sampled_from([HEAD, PCD]), st.integers(0, 120))
def test_no_bytes_break_the_readers(tmp_path_factory: pytest.TempPathFactory, noise: bytes, head: bytes, keep: int) -> None:
    path = tmp_path_factory.getbasetemp() / ("noise.ply" if head is HEAD else "noise.pcd")
    path.write_bytes(head[:keep] + noise)
    try:
        xyz, _, _ = cloud.read(path)
    except SlamError:
        return
    assert xyz.shape[1] == 3
