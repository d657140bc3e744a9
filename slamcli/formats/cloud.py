"""PLY and PCD point clouds, and PLY meshes. Readers take what this and other programs write; coordinates are metres."""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.formats.e57 import write_e57
from slamcli.formats.las import write_las

Points = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]  # xyz (N, 3) float32, rgb (N, 3) uint8, normal (N, 3) float32

PLY_TYPE = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
PLY_NAME = {"f4": "float", "u1": "uchar"}
MAX_HEADER = 65536  # bytes
AT_ONCE = 1 << 18  # points put in order and written in turn
MAX_POINTS = 1 << 30
MAX_NUMBER = 64  # bytes of a number in a text file, with what separates it from the next
PCD_KINDS = {
    "F": {"4": "f4", "8": "f8"},
    "U": {"1": "u1", "2": "u2", "4": "u4", "8": "u8"},
    "I": {"1": "i1", "2": "i2", "4": "i4", "8": "i8"},
}


def write(path: Path, xyz: np.ndarray, rgb: np.ndarray | None = None, normal: np.ndarray | None = None) -> None:
    """Write points (N, 3), colours (N, 3) uint8 and normals (N, 3) in the format that the suffix names, one of `WRITERS`."""
    _by_suffix(path, WRITERS)(path, xyz, rgb, normal)


def read(path: Path) -> Points:
    """Read a .ply or .pcd file: points, and colours and normals where it has them."""
    return _by_suffix(path, {".ply": read_ply, ".pcd": read_pcd})(path)


def _by_suffix(path: Path, functions: dict[str, Callable]) -> Callable:
    suffix = Path(path).suffix.lower()
    if suffix not in functions:
        raise SlamError(f"{path}: a point cloud's name ends in {' or '.join(functions)}")
    return functions[suffix]


def write_ply(path: Path, xyz: np.ndarray, rgb: np.ndarray | None = None, normal: np.ndarray | None = None) -> None:
    """Write points as binary little-endian PLY."""
    with files.whole(path) as file:
        file.write(_ply_header(_vertices(*_rows(slice(0), xyz, rgb, normal)).dtype, len(xyz), n_faces=None))
        _write_vertices(file, xyz, rgb, normal)


def write_ply_mesh(
    path: Path, xyz: np.ndarray, triangle: np.ndarray, rgb: np.ndarray | None = None, normal: np.ndarray | None = None
) -> None:
    """Write a mesh as binary little-endian PLY: vertices as in `write_ply`, triangles (M, 3) of vertex rows."""
    face = np.empty(len(triangle), dtype=[("n", "u1"), ("vertex", "<i4", 3)])
    face["n"], face["vertex"] = 3, triangle
    with files.whole(path) as file:
        file.write(_ply_header(_vertices(*_rows(slice(0), xyz, rgb, normal)).dtype, len(xyz), n_faces=len(face)))
        _write_vertices(file, xyz, rgb, normal)
        file.write(face.tobytes())


def _write_vertices(file: BinaryIO, xyz: np.ndarray, rgb: np.ndarray | None, normal: np.ndarray | None) -> None:
    for first in range(0, len(xyz), AT_ONCE):
        file.write(_vertices(*_rows(slice(first, first + AT_ONCE), xyz, rgb, normal)).tobytes())


def _rows(rows: slice, xyz: np.ndarray, *others: np.ndarray | None) -> list:
    return [xyz[rows], *(None if values is None else values[rows] for values in others)]


def _vertices(xyz: np.ndarray, rgb: np.ndarray | None, normal: np.ndarray | None) -> np.ndarray:
    groups = [("x y z", "f4", xyz), ("nx ny nz", "f4", normal), ("red green blue", "u1", rgb)]
    present = [(names.split(), kind, value) for names, kind, value in groups if value is not None]
    out = np.empty(len(xyz), dtype=np.dtype([(name, kind) for names, kind, _ in present for name in names]).newbyteorder("<"))
    for names, _, value in present:
        for i, name in enumerate(names):
            out[name] = value[:, i]
    return out


def _ply_header(vertex: np.dtype, n_vertices: int, *, n_faces: int | None) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n_vertices}"]
    lines += [f"property {PLY_NAME[vertex[name].str[1:]]} {name}" for name in _names(vertex)]
    if n_faces is not None:
        lines += [f"element face {n_faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", ""]).encode()


def read_ply(path: Path) -> Points:
    """Read the vertices of an ASCII or binary PLY file; SlamError for one that is not what its header says."""
    with files.open_regular(path) as file:
        encoding, dtype, n = _read_ply_header(path, file)
        if encoding == "ascii":
            return _points(path, _read_text(path, file, dtype, n))
        return _points(path, _read_records(path, file, dtype, n))


def read_coloured_ply(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read the vertices of a PLY file as `read_ply` does; SlamError also where they have no colours."""
    xyz, rgb, normal = read_ply(path)
    if rgb is None:
        raise SlamError(f"{path}: the points have no colours (red green blue)")
    return xyz, rgb, normal


def _read_ply_header(path: Path, file: BinaryIO) -> tuple[str, np.dtype, int]:
    """Read up to the vertices; gives the format, the type of a vertex and their number."""
    lines = _header_lines(path, file, first="ply", last="end_header", kind="PLY")
    encoding = next((words[1] for words in lines if words[0] == "format" and len(words) > 1), "")
    if encoding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise SlamError(f"{path}: the PLY format {encoding[:40]!r} is not known")
    elements = [words for words in lines if words[0] == "element"]
    if not elements or elements[0][1:2] != ["vertex"] or len(elements[0]) != 3:
        raise SlamError(f"{path}: the first element of the PLY file is not 'vertex'")
    n = _count(path, elements[0][2], "vertices")
    fields = []
    for words in lines[lines.index(elements[0]) + 1 :]:
        if words[0] == "element":
            break
        if words[0] == "property":
            if len(words) != 3 or words[1] not in PLY_TYPE:
                raise SlamError(f"{path}: the vertex property {' '.join(words[1:])[:60]!r} cannot be read")
            fields.append((words[2], PLY_TYPE[words[1]]))
    return encoding, _record_type(path, fields, ">" if encoding == "binary_big_endian" else "<"), n


def write_pcd(path: Path, xyz: np.ndarray, rgb: np.ndarray | None = None, normal: np.ndarray | None = None) -> None:
    """Write points as binary PCD v0.7, the colour packed in a float as the Point Cloud Library does."""
    groups = [("x y z", xyz), ("normal_x normal_y normal_z", normal)]
    columns = [(name, value[:, i]) for names, value in groups if value is not None for i, name in enumerate(names.split())]
    if rgb is not None:
        red, green, blue = rgb.astype(np.uint32).T
        columns.append(("rgb", (red << 16 | green << 8 | blue).view(np.float32)))
    point = np.empty(len(xyz), dtype=[(name, "<f4") for name, _ in columns])
    for name, value in columns:
        point[name] = value
    k = len(columns)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(name for name, _ in columns)}\nSIZE{' 4' * k}\nTYPE{' F' * k}\nCOUNT{' 1' * k}\n"
        f"WIDTH {len(point)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(point)}\nDATA binary\n"
    )
    with files.whole(path) as file:
        file.write(header.encode())
        file.write(point.tobytes())


def read_pcd(path: Path) -> Points:
    """Read an ASCII or binary PCD file; SlamError for one that is not what its header says."""
    with files.open_regular(path) as file:
        lines = _header_lines(path, file, first="", last="DATA", kind="PCD")
        header = {words[0]: words[1:] for words in lines}
        names = header.get("FIELDS", [])
        kinds = [PCD_KINDS.get(kind, {}).get(size, "") for kind, size in zip(header.get("TYPE", []), header.get("SIZE", []), strict=False)]
        counts = header.get("COUNT", ["1"] * len(names))
        if not names or len(kinds) != len(names) or not all(kinds) or counts != ["1"] * len(names):
            raise SlamError(
                f"{path}: the PCD header's FIELDS, SIZE, TYPE and COUNT do not describe single numbers, or of a type that is not known"
            )
        n = _count(path, " ".join(header.get("POINTS", [])), "points")
        encoding = " ".join(header["DATA"])
        dtype = _record_type(path, list(zip(names, kinds, strict=True)), "<")
        if encoding == "ascii":
            return _points(path, _read_text(path, file, dtype, n))
        if encoding != "binary":
            raise SlamError(f"{path}: PCD data of type {encoding[:40]!r} cannot be read; convert it with: pcl_convert_pcd_ascii_binary")
        return _points(path, _read_records(path, file, dtype, n))


def _header_lines(path: Path, file: BinaryIO, *, first: str, last: str, kind: str) -> list[list[str]]:
    """Read lines as words up to the one that starts with `last`, without comments; the file stands behind it."""
    lines: list[list[str]] = []
    used = 0
    while used < MAX_HEADER:
        line = file.readline(MAX_HEADER - used)
        used += len(line)
        words = line.decode("latin-1").split()
        if (first and used == len(line) and words != [first]) or not line:
            break
        if words and not words[0].startswith("#") and words[0] not in ("comment", "obj_info"):
            lines.append(words)
        if words and words[0] == last:
            return lines
    raise SlamError(f"{path}: is not a {kind} file, or its header is cut off")


def _count(path: Path, text: str, what: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 12) or int(text) > MAX_POINTS:
        raise SlamError(f"{path}: the header gives {text[:40]!r} as the number of {what}")
    return int(text)


def _record_type(path: Path, fields: list[tuple[str, str]], order: Literal["<", ">"]) -> np.dtype:
    names = [name for name, _ in fields]
    if len(set(names)) != len(names) or not {"x", "y", "z"} <= set(names):
        raise SlamError(f"{path}: the points have no x, y and z, or a field twice")
    try:
        return np.dtype(fields).newbyteorder(order)
    except TypeError:
        raise SlamError(f"{path}: the header gives a field a type that is not known") from None


def _names(dtype: np.dtype) -> tuple[str, ...]:
    return dtype.names or ()


def _read_records(path: Path, file: BinaryIO, dtype: np.dtype, n: int) -> dict[str, np.ndarray]:
    here = file.tell()
    available = file.seek(0, 2) - here
    if n * dtype.itemsize > available:  # checked before anything of that size is reserved
        raise SlamError(f"{path}: is cut off: {n} points need {n * dtype.itemsize} bytes, {available} are there")
    file.seek(here)
    records = np.frombuffer(file.read(n * dtype.itemsize), dtype=dtype)
    return {name: records[name] for name in _names(dtype)}


def _read_text(path: Path, file: BinaryIO, dtype: np.dtype, n: int) -> dict[str, np.ndarray]:
    names = _names(dtype)
    words = file.read(n * len(names) * MAX_NUMBER).split()
    if n * len(names) > len(words):
        raise SlamError(f"{path}: is cut off: {n} points need {n * len(names)} numbers, {len(words)} are there")
    try:
        table = np.array(words[: n * len(names)], dtype=np.float64).reshape(n, len(names))
    except ValueError:
        raise SlamError(f"{path}: holds something that is not a number") from None
    return {name: table[:, i].astype(dtype[name]) for i, name in enumerate(names)}


def _points(path: Path, columns: dict[str, np.ndarray]) -> Points:
    def group(names: str, dtype: type) -> np.ndarray | None:
        present = [columns[name] for name in names.split() if name in columns]
        return np.column_stack(present).astype(dtype) if len(present) == len(names.split()) else None

    xyz = group("x y z", np.float32)
    if xyz is None or not np.isfinite(xyz).all():
        raise SlamError(f"{path}: holds a point that is not finite")
    rgb = group("red green blue", np.uint8)
    packed = columns.get("rgb")
    if packed is not None:
        bits = packed.astype(np.float32).view(np.uint32) if packed.dtype.kind == "f" else packed.astype(np.uint32)
        rgb = np.column_stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255]).astype(np.uint8)
    normal = group("nx ny nz", np.float32)
    return xyz, rgb, normal if normal is not None else group("normal_x normal_y normal_z", np.float32)


WRITERS: dict[str, Callable] = {".ply": write_ply, ".pcd": write_pcd, ".las": write_las, ".laz": write_las, ".e57": write_e57}
