"""The text format of DBoW2 vocabularies, as ORB-SLAM's ORBvoc.txt.

First line `branching depth scoring weighting`; then a line a node, in the order of ids from 1 (the root is 0 and has none):
`parent is_leaf d0 .. d31 weight`. Words are the leaves in that order.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.errors import SlamError

L1_NORM, TF_IDF = 0, 0
MAX_BRANCHING, MAX_DEPTH = 20, 10  # what DBoW2's own reader takes
MAX_BYTES = 1 << 30  # ORBvoc.txt has 145 million
MAX_NODES = 4_000_000
COLUMNS = 35  # of a line: parent, is_leaf, 32 bytes, weight
BLOCK = 1 << 24  # bytes parsed at a time


@dataclass(frozen=True)
class Tree:
    """A vocabulary tree as a table of nodes; row r is node r + 1."""

    branching: int
    depth: int
    parent: np.ndarray  # (N,) int32, node id, 0 = root, always smaller than the node's own
    centre: np.ndarray  # (N, 32) uint8
    weight: np.ndarray  # (N,) float32, of leaves; 0 for inner nodes


def read(path: str | Path) -> Tree:
    """Read a vocabulary; SlamError names the file, the line and the fault."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise SlamError(f"{path}: {size >> 20} MB is too large for a vocabulary (at most {MAX_BYTES >> 20} MB)")
        with files.open_regular(path) as file:
            branching, depth = _header(file.readline(256), path)
            tables = []
            for table in _blocks(file, path):
                tables.append(table)
                if sum(map(len, tables)) > MAX_NODES:
                    raise SlamError(f"{path}: more than {MAX_NODES} nodes are too many for a vocabulary")
    except OSError as error:
        raise SlamError(f"{path}: the vocabulary cannot be read ({error.strerror or error})") from error
    if not tables:
        raise SlamError(f"{path}: the vocabulary has no nodes: is the file cut off?")
    return _tree(np.concatenate(tables), branching, depth, path)


def write(path: str | Path, tree: Tree) -> None:
    """Write a vocabulary. There is no line end after the last node: DBoW2's reader would take the empty line for another node."""
    if tree.branching > MAX_BRANCHING or tree.depth > MAX_DEPTH:
        limits = f"at most {MAX_BRANCHING} children and {MAX_DEPTH} levels; this vocabulary has {tree.branching} and {tree.depth}"
        raise SlamError(f"{path}: DBoW2 reads {limits}")
    is_leaf = np.ones(len(tree.parent) + 1, dtype=np.int64)
    is_leaf[tree.parent] = 0
    lines = [f"{tree.branching} {tree.depth} {L1_NORM} {TF_IDF}"]
    for parent, leaf, centre, weight in zip(
        tree.parent.tolist(), is_leaf[1:].tolist(), tree.centre.tolist(), tree.weight.tolist(), strict=True
    ):
        lines.append(f"{parent} {leaf} {' '.join(map(str, centre))} {weight:.9g}")
    files.write_text(path, "\n".join(lines))


def _header(line: bytes, path: Path) -> tuple[int, int]:
    words = line.split()
    if len(words) != 4 or not all(word.isdigit() and len(word) < 9 for word in words):
        raise SlamError(f"{path}: line 1 is not `branching depth scoring weighting`: not a DBoW2 vocabulary in text form")
    branching, depth, scoring, weighting = (int(word) for word in words)
    if not (2 <= branching <= MAX_BRANCHING and 1 <= depth <= MAX_DEPTH):
        raise SlamError(f"{path}: line 1: {branching} children and {depth} levels; DBoW2 has 2 to {MAX_BRANCHING} and 1 to {MAX_DEPTH}")
    if (scoring, weighting) != (L1_NORM, TF_IDF):
        raise SlamError(f"{path}: line 1: scoring {scoring} and weighting {weighting}; only L1 norm (0) with TF-IDF (0) is used here")
    return branching, depth


def _blocks(file, path: Path):
    """Yield tables (n, 35) float64 of whole lines."""
    line, rest = 2, b""
    while block := file.read(BLOCK):
        block = rest + block
        cut = block.rfind(b"\n") + 1
        if cut == 0 and len(block) > BLOCK:
            raise SlamError(f"{path}: line {line} is too long for a DBoW2 vocabulary")
        rest, block = block[cut:], block[:cut]
        if block:
            yield _table(block, path, line)
            line += block.count(b"\n")
    if rest.strip():
        yield _table(rest, path, line)


def _table(block: bytes, path: Path, line: int) -> np.ndarray:
    lines = [text for text in block.split(b"\n") if text.strip()]
    for k, text in enumerate(lines):
        if text.count(b" ") + text.count(b"\t") < COLUMNS - 1 or len(text.split()) != COLUMNS:
            raise SlamError(f"{path}: line {line + k} has {len(text.split())} numbers instead of {COLUMNS}: is the file cut off?")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.fromstring(block.decode("ascii"), sep=" ")
    except (UnicodeDecodeError, DeprecationWarning, ValueError) as error:
        raise SlamError(f"{path}: lines {line} to {line + len(lines)} hold something that is no number") from error
    if len(values) != COLUMNS * len(lines):
        raise SlamError(f"{path}: lines {line} to {line + len(lines)} hold something that is no number")
    return values.reshape(-1, COLUMNS)


def _tree(table: np.ndarray, branching: int, depth: int, path: Path) -> Tree:
    parent, is_leaf, centre, weight = table[:, 0], table[:, 1], table[:, 2:34], table[:, 34]
    own = np.arange(1, len(table) + 1)
    for is_wrong, fault in (
        (~((parent >= 0) & (parent < own) & (parent == np.floor(parent))), "its parent does not stand before it"),
        (~np.isin(is_leaf, (0, 1)), "its leaf mark is neither 0 nor 1"),
        (~((centre >= 0) & (centre <= 255) & (centre == np.floor(centre))).all(axis=1), "its descriptor is not 32 bytes"),
        (~(np.isfinite(weight) & (weight >= 0)), "its weight is negative or not a number"),
    ):
        if is_wrong.any():
            raise SlamError(f"{path}: line {int(np.argmax(is_wrong)) + 2}: {fault}")
    ancestor = parent.astype(np.int64)
    for _ in range(depth - 1):  # the root's children have reached it, their children do in the next round, and so on
        ancestor = np.concatenate([[0], parent.astype(np.int64)])[ancestor]
    if ancestor.any():
        raise SlamError(f"{path}: line {int(np.argmax(ancestor > 0)) + 2}: deeper than the {depth} levels that line 1 says")
    n_children = np.bincount(parent.astype(np.int64), minlength=len(table) + 1)
    if n_children.max() > branching:
        raise SlamError(f"{path}: node {int(n_children.argmax())} has {n_children.max()} children; line 1 says {branching} at most")
    is_wrong = (n_children[1:] == 0) != (is_leaf == 1)
    if is_wrong.any():
        at = int(np.argmax(is_wrong))
        fault = "a leaf has children" if is_leaf[at] else "an inner node has no children: is the file cut off?"
        raise SlamError(f"{path}: line {at + 2}: {fault}")
    return Tree(branching, depth, parent.astype(np.int32), centre.astype(np.uint8), weight.astype(np.float32))
