"""OctoMap's files: `.ot` (log-odds of every node, and its colour in a ColorOcTree) and `.bt` (leaves free or occupied, two bits a child).

A text header, `size` counting all nodes, then the nodes depth first. A. Hornung et al., OctoMap, Autonomous Robots 2013,
doi:10.1007/s10514-012-9321-0, section 4.4; checked against the C++ library.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.geometry import voxel
from slamcli.geometry.octree import DEPTH, Level, Octree, levels, preorder, prune
from slamcli.jit.kernel import kernel

MAGIC = {".ot": b"# Octomap OcTree file", ".bt": b"# Octomap OcTree binary file"}
NODE = np.dtype([("log_odds", "<f4"), ("children", "u1")])
COLOUR_NODE = np.dtype([("log_odds", "<f4"), ("rgb", "u1", 3), ("children", "u1")])
NO_COLOUR = 255  # of all three channels, as in OctoMap
MAX_HEADER = 4096  # bytes; real ones have some 150
MAX_NODES = 1 << 28  # a tree of 250 million nodes takes 4 GB in memory

OK, CUT_OFF, TOO_DEEP, NOT_FINITE, TOO_MANY = range(5)
FAULT = {
    CUT_OFF: "is cut off: the data ends in the middle of the tree",
    TOO_DEEP: "is damaged: a branch is deeper than 16 levels",
    NOT_FINITE: "is damaged: a node's log-odds are not a finite number",
    TOO_MANY: "is damaged: the tree has more nodes than `size` in the header says",
}


def write_ot(path: Path, tree: Octree, *, parents: str = "max") -> int:
    """Write the tree with its log-odds; returns the number of nodes."""
    record, _ = _records(tree, parents, NODE)
    _write(path, ".ot", tree.resolution, len(record), record)
    return len(record)


def write_colour_ot(path: Path, tree: Octree, xyz: np.ndarray, rgb: np.ndarray, *, parents: str = "max") -> int:
    """Write the tree with the mean colour of the points in each occupied node, as a ColorOcTree; returns the number of nodes.

    xyz : (N, 3) [m], in the tree's frame; rgb : (N, 3) uint8
    """
    record, nodes = _records(tree, parents, COLOUR_NODE)
    cell = tree.cells(xyz)
    inside = ((cell >= 0) & (cell < 1 << DEPTH)).all(axis=1)
    key = voxel.morton(cell[inside])
    order = np.argsort(key)
    key, total = key[order], np.zeros((len(order) + 1, 3), dtype=np.int64)
    np.cumsum(rgb[inside][order], axis=0, out=total[1:])
    for depth, (level, place) in enumerate(zip(nodes, preorder(nodes), strict=True)):
        first, last = (np.searchsorted(key, (level.prefix + k) << 3 * (DEPTH - depth)) for k in (0, 1))
        has_colour = (last > first) & (level.log_odds >= 0.0)
        mean = (total[last] - total[first]) / np.maximum(last - first, 1)[:, None]
        record["rgb"][place] = np.where(has_colour[:, None], np.rint(mean), NO_COLOUR)
    _write(path, ".ot", tree.resolution, len(record), record, kind="ColorOcTree")
    return len(record)


def _records(tree: Octree, parents: str, dtype: np.dtype) -> tuple[np.ndarray, list[Level]]:
    """Return all nodes depth first, with log-odds and children filled in, and level by level."""
    nodes = levels(tree, parents=parents)
    record = np.empty(_n_nodes(nodes), dtype=dtype)
    for level, place in zip(nodes, preorder(nodes), strict=True):
        record["log_odds"][place] = level.log_odds
        record["children"][place] = level.children
    return record, nodes


def write_bt(path: Path, tree: Octree, *, threshold: float = 0.0) -> int:
    """Write which leaves are occupied, as OctoMap does after making the tree maximum-likelihood; returns the number of nodes.

    threshold : log-odds from which on a leaf is occupied
    """
    likely = np.where(tree.is_occupied(threshold), np.float32(1.0), np.float32(-1.0))
    nodes = levels(prune(Octree(tree.resolution, tree.key, tree.depth, likely)))
    # The root is written as an inner node even when it is the only node.
    code = np.zeros(max(1, int(nodes[0].n_inner.sum())), dtype="<u2")
    for level, place in zip(nodes, preorder(nodes, inner_only=True), strict=True):
        is_inner = level.children > 0
        code[place[is_inner]] = level.child_code[is_inner]
    _write(path, ".bt", tree.resolution, _n_nodes(nodes), code if len(tree) else code[:0])
    return _n_nodes(nodes)


def _n_nodes(nodes: list) -> int:
    return int(nodes[0].n_nodes.sum())


def _write(path: Path, suffix: str, resolution: float, size: int, data: np.ndarray, *, kind: str = "OcTree") -> None:
    header = (
        f"{MAGIC[suffix].decode()}\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id {kind}\nsize {size}\nres {resolution:g}\ndata\n"
    )
    with files.whole(path) as file:
        file.write(header.encode())
        file.write(data.tobytes())


def read(path: Path) -> Octree:
    """Read a `.ot` or `.bt` file, told apart by its first line; in a `.bt`, log-odds are -2 or 3.5, OctoMap's clamping bounds.

    Colours are passed over. Raises SlamError for a file that is not what its header says; memory is bounded by the size of the file.
    """
    with files.open_regular(path) as file:
        suffix, kind, size, resolution = _read_header(path, file)
        data = file.read()
    node = COLOUR_NODE if kind == "ColorOcTree" else NODE
    n_max = len(data) // node.itemsize if suffix == ".ot" else 1 + 4 * len(data)
    if size > min(n_max, MAX_NODES):
        raise SlamError(f"{path}: is cut off: the header says {size} nodes, the data can hold {n_max} at most; write the file again")
    key, depth, log_odds = np.empty(size, np.int64), np.empty(size, np.uint8), np.empty(size, np.float32)
    if size == 0:
        fault, n, n_nodes, used = OK, 0, 0, 0
    elif suffix == ".ot":
        record = np.frombuffer(data, dtype=node, count=len(data) // node.itemsize)
        value, children = np.ascontiguousarray(record["log_odds"]), np.ascontiguousarray(record["children"])
        fault, n, n_nodes = _parse_ot(value, children, key, depth, log_odds)
        used = n_nodes * node.itemsize
    else:
        code = np.frombuffer(data, dtype="<u2", count=len(data) // 2).astype(np.uint16)
        fault, n, n_nodes, used = _parse_bt(code, np.float32(-2.0), np.float32(3.5), key, depth, log_odds)
    if fault != OK:
        raise SlamError(f"{path}: {FAULT[fault]}; write the file again")
    if n_nodes != size:
        raise SlamError(f"{path}: is damaged: the header says {size} nodes, the tree has {n_nodes}; write the file again")
    if used != len(data):
        raise SlamError(f"{path}: is damaged: {len(data) - used} bytes follow the tree; write the file again")
    return Octree(resolution, key[:n].copy(), depth[:n].copy(), log_odds[:n].copy())


def _read_header(path: Path, file: BinaryIO) -> tuple[str, str, int, float]:
    head = file.read(MAX_HEADER)
    first, _, rest = head.partition(b"\n")
    suffix = next((s for s, magic in MAGIC.items() if first.strip() == magic), None)
    if suffix is None:
        known = " nor ".join(repr(magic.decode()) for magic in MAGIC.values())
        raise SlamError(f"{path}: is not an OctoMap file: the first line is neither {known}")
    values: dict[str, str] = {}
    at = len(first) + 1
    while rest:
        line, newline, rest = rest.partition(b"\n")
        at += len(line) + len(newline)
        words = line.decode("ascii", errors="replace").split()
        if words == ["data"] and newline:
            break
        if words and not words[0].startswith("#"):
            values[words[0]] = " ".join(words[1:])
    else:
        raise SlamError(f"{path}: the header has no line 'data' within {MAX_HEADER} bytes; write the file again")
    file.seek(at)
    kind = values.get("id", "(none)")
    if kind not in ("OcTree", "ColorOcTree"):
        raise SlamError(f"{path}: holds a tree of type {kind[:40]!r}; only OcTree and ColorOcTree can be read")
    return suffix, kind, int(_number(path, values, "size", int, 0, 1 << 62)), float(_number(path, values, "res", float, 1e-6, 1e6))


def _number(path: Path, values: dict[str, str], name: str, kind: type, low: float, high: float) -> int | float:
    try:
        value = kind(values[name])
    except KeyError:
        raise SlamError(f"{path}: the header has no {name!r}; write the file again") from None
    except ValueError:
        raise SlamError(f"{path}: the header's {name} is {values[name][:40]!r}, not a number; write the file again") from None
    if not low <= value <= high:
        raise SlamError(f"{path}: the header's {name} is {values[name][:40]}, which cannot be; write the file again")
    return value


@kernel
def _parse_ot(value, children, key, depth, log_odds):
    """Walk the nodes depth first and list the leaves; returns fault, leaves, nodes."""
    prefix = np.zeros(DEPTH + 1, dtype=np.int64)  # key of the open node at each depth
    pending = np.zeros(DEPTH + 1, dtype=np.int64)  # its children still to come, as bits
    n, at, level = 0, 0, 0
    while True:
        if at >= len(value):
            return CUT_OFF, n, at
        if not np.isfinite(value[at]):
            return NOT_FINITE, n, at
        pending[level] = children[at]
        if children[at] == 0:
            key[n], depth[n], log_odds[n] = prefix[level], level, value[at]
            n += 1
        elif level == DEPTH:
            return TOO_DEEP, n, at
        at += 1
        while level >= 0 and pending[level] == 0:
            level -= 1
        if level < 0:
            return OK, n, at
        if at >= len(key):
            return TOO_MANY, n, at
        child = 0
        while not pending[level] >> child & 1:
            child += 1
        pending[level] &= pending[level] - 1
        prefix[level + 1] = prefix[level] + (child << 3 * (DEPTH - 1 - level))
        level += 1


@kernel
def _parse_bt(code, free, occupied, key, depth, log_odds):
    """Walk the inner nodes depth first and list the leaves; returns fault, leaves, nodes, bytes used."""
    prefix = np.zeros(DEPTH + 1, dtype=np.int64)
    pending = np.zeros(DEPTH + 1, dtype=np.int64)  # codes of the children still to come, two bits each
    child = np.zeros(DEPTH + 1, dtype=np.int64)
    if len(code) == 0:
        return CUT_OFF, 0, 0, 0
    pending[0] = code[0]
    n, n_nodes, at, level = 0, 1, 1, 0
    while level >= 0:
        if child[level] == 8:
            level -= 1
            continue
        kind = pending[level] >> 2 * child[level] & 3
        below = prefix[level] + (child[level] << 3 * (DEPTH - 1 - level))
        child[level] += 1
        if kind == 0:
            continue
        n_nodes += 1
        if n_nodes > len(key):
            return TOO_MANY, n, n_nodes, 2 * at
        if kind == 3:
            if level == DEPTH - 1:
                return TOO_DEEP, n, n_nodes, 2 * at
            if at >= len(code):
                return CUT_OFF, n, n_nodes, 2 * at
            level += 1
            prefix[level], pending[level], child[level] = below, code[at], 0
            at += 1
        else:
            key[n], depth[n], log_odds[n] = below, level + 1, free if kind == 1 else occupied
            n += 1
    return OK, n, n_nodes, 2 * at
