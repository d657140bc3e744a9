"""Pose graphs as g2o text files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.geometry.g2o_convention import from_g2o_information, to_g2o_information

MAX_LINES = 5_000_000  # of a file read
LONGEST_LINE = 4096  # bytes; an edge has some 600
LARGEST = {"id": 1 << 62, "number": 1e150}  # whose square is still finite
COLUMNS = {"VERTEX_SE3:QUAT": (1, 7), "EDGE_SE3:QUAT": (2, 28), "FIX": (1, 0)}  # whole numbers, real numbers


def write_g2o(
    path: Path, T_wk: np.ndarray, edge_kf: np.ndarray, edge_T_ij: np.ndarray, information: np.ndarray, *, is_fixed: np.ndarray | None = None
) -> None:
    """Write a pose graph as g2o text: VERTEX_SE3:QUAT id x y z qx qy qz qw, FIX, EDGE_SE3:QUAT i j pose, information row by row."""
    is_fixed = np.arange(len(T_wk)) == 0 if is_fixed is None else is_fixed
    pose, measurement = _pose_rows(T_wk), _pose_rows(edge_T_ij)
    i, j = np.triu_indices(6)
    upper = to_g2o_information(np.asarray(edge_T_ij), np.asarray(information))[:, i, j]
    lines = [f"VERTEX_SE3:QUAT {k} {_numbers(row)}" for k, row in enumerate(pose)]
    lines += [f"FIX {k}" for k in np.flatnonzero(is_fixed).tolist()]
    for (kf_i, kf_j), row, omega in zip(np.asarray(edge_kf).tolist(), measurement, upper, strict=True):
        lines.append(f"EDGE_SE3:QUAT {kf_i} {kf_j} {_numbers(row)} {_numbers(omega)}")
    files.write_text(path, "".join(f"{line}\n" for line in lines))


@dataclass(frozen=True)
class GraphFile:
    """A pose graph as a file holds it."""

    vertex: np.ndarray  # (K,) the file's vertex numbers, increasing
    T_wk: np.ndarray  # (K, 4, 4)
    edge_kf: np.ndarray  # (E, 2) rows of T_wk
    edge_T_ij: np.ndarray  # (E, 4, 4)
    information: np.ndarray  # (E, 6, 6) of left twists
    is_fixed: np.ndarray  # (K,) bool


def read_g2o(path: Path) -> GraphFile:
    """Read the SE(3) vertices and edges of a g2o text file; other lines are skipped. SlamError names file and line of what is wrong."""
    vertices, edges, fixed = {}, [], set()
    try:
        with files.open_regular(path) as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), start=1):
                if number > MAX_LINES or len(line) == LONGEST_LINE:
                    raise SlamError(f"{path}: more than {MAX_LINES} lines, or one too long; not a pose graph this program would read")
                words = line.decode("ascii").split()
                if not words or words[0] not in COLUMNS:
                    continue
                values = _parse(words, f"{path}:{number}")
                if words[0] == "FIX":
                    fixed.update(values)
                elif words[0] == "VERTEX_SE3:QUAT":
                    vertices[values[0]] = values[1:]
                else:
                    edges.append((f"{path}:{number}", values))
    except (OSError, UnicodeDecodeError) as error:
        raise SlamError(f"{path}: cannot be read as a g2o text file ({error})") from error
    vertex = np.array(sorted(vertices), dtype=np.int64)
    row = {name: k for k, name in enumerate(vertex.tolist())}
    for where, values in edges:
        for name in values[:2]:
            if name not in row:
                raise SlamError(f"{where}: the edge names vertex {name}, which the file does not define")
    pose = np.array([vertices[name] for name in vertex.tolist()]).reshape(-1, 7)
    measured = np.array([values[2:] for _, values in edges]).reshape(-1, 28)
    T_ij = se3.from_quaternion(measured[:, :3], measured[:, 3:7])
    omega = np.zeros((len(edges), 6, 6))
    i, j = np.triu_indices(6)
    omega[:, i, j] = omega[:, j, i] = measured[:, 7:]
    return GraphFile(
        vertex=vertex,
        T_wk=se3.from_quaternion(pose[:, :3], pose[:, 3:]),
        edge_kf=np.array([[row[a], row[b]] for _, (a, b, *_) in edges], dtype=np.int64).reshape(-1, 2),
        edge_T_ij=T_ij,
        information=from_g2o_information(T_ij, omega),
        is_fixed=np.isin(vertex, sorted(fixed)),
    )


def _parse(words: list[str], where: str) -> list:
    n_ids, n_values = COLUMNS[words[0]]
    if words[0] == "FIX":
        n_ids = len(words) - 1
    if len(words) != 1 + n_ids + n_values:
        raise SlamError(f"{where}: {words[0]} needs {n_ids + n_values} numbers, found {len(words) - 1}")
    try:
        values = [*map(int, words[1 : 1 + n_ids]), *map(float, words[1 + n_ids :])]
    except ValueError:
        raise SlamError(f"{where}: {words[0]} holds something that is not a number") from None
    if any(abs(name) > LARGEST["id"] for name in values[:n_ids]):
        raise SlamError(f"{where}: {words[0]} names a vertex beyond all that can be counted")
    if not (np.abs(values[n_ids:]) <= LARGEST["number"]).all():
        raise SlamError(f"{where}: {words[0]} holds a number that is not finite, or as good as")
    if n_values and not 0.5 < np.linalg.norm(values[n_ids + 3 : n_ids + 7]) < 2.0:
        raise SlamError(f"{where}: {words[0]} has a rotation that is not a unit quaternion")
    return values


def _pose_rows(T: np.ndarray) -> np.ndarray:
    T = np.asarray(T, dtype=np.float64).reshape(-1, 4, 4)
    return np.concatenate([T[:, :3, 3], se3.quaternion_xyzw(T)], axis=1) if len(T) else np.zeros((0, 7))


def _numbers(row: np.ndarray) -> str:
    return " ".join(repr(value) for value in row.tolist())
