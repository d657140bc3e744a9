"""An octree as a sorted list of leaves, and its nodes level by level.

The tree has OctoMap's depth of 16: a leaf's cell numbers are 0 to 65535 per axis, cell 32768 starting at coordinate 0, and a leaf at
depth d is a cube of 2^(16 - d) cells. A leaf's key is the Morton key of its lowest cell, so that order by key is depth-first order.

A. Hornung et al., OctoMap, Autonomous Robots 2013, doi:10.1007/s10514-012-9321-0
"""

from dataclasses import dataclass

import numpy as np

from slamcli.geometry import voxel

DEPTH = 16
CENTRE = 1 << (DEPTH - 1)  # cell number whose lower face is coordinate 0


@dataclass(frozen=True)
class Octree:
    """Leaves, sorted by key and disjoint."""

    resolution: float  # m, side of a cell at depth 16
    key: np.ndarray  # (N,) int64, Morton key of the lowest cell
    depth: np.ndarray  # (N,) uint8, 0 to 16
    log_odds: np.ndarray  # (N,) float32

    def __len__(self) -> int:
        return len(self.key)

    @property
    def side(self) -> np.ndarray:
        """Return the sides of the leaves (N,) [m]."""
        return self.resolution * np.ldexp(1.0, DEPTH - self.depth.astype(np.int32))

    @property
    def centre(self) -> np.ndarray:
        """Return the centres of the leaves (N, 3) [m]."""
        return (voxel.unmorton(self.key) - CENTRE) * self.resolution + 0.5 * self.side[:, None]

    def is_occupied(self, threshold: float = 0.0) -> np.ndarray:
        """Say for each leaf whether its log-odds reach the threshold; 0 is a probability of 0.5."""
        return self.log_odds >= threshold

    def find(self, cell: np.ndarray) -> np.ndarray:
        """Return the row of the leaf that holds each cell (M, 3), -1 where space is unknown."""
        cell = np.asarray(cell, dtype=np.int64)
        inside = np.all((cell >= 0) & (cell < 1 << DEPTH), axis=-1)
        key = voxel.morton(np.where(inside[..., None], cell, 0))
        row = np.searchsorted(self.key, key, side="right") - 1
        found = inside & (row >= 0)
        at = np.where(found, row, 0)
        found &= len(self.key) > 0
        if len(self.key):
            found &= (key - self.key[at]) >> (3 * (DEPTH - self.depth[at].astype(np.int64))) == 0
        return np.where(found, row, -1)

    def cells(self, xyz: np.ndarray) -> np.ndarray:
        """Return the cells (M, 3) int64 that hold points (M, 3) [m]."""
        return np.floor(np.asarray(xyz, dtype=np.float64) * (1.0 / self.resolution)).astype(np.int64) + CENTRE


def prune(tree: Octree) -> Octree:
    """Merge eight equal sibling leaves into their parent, again and again from the finest level up."""
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    key, log_odds = tree.key[tree.depth == DEPTH], tree.log_odds[tree.depth == DEPTH]
    for level in range(DEPTH, 0, -1):
        first = _whole_families(key >> 3 * (DEPTH - level), log_odds)
        merged = np.zeros(len(key), dtype=bool)
        merged[(first[:, None] + np.arange(8)).ravel()] = True
        done.append((key[~merged], np.full((~merged).sum(), level, dtype=np.uint8), log_odds[~merged]))
        above = tree.depth == level - 1
        key = np.concatenate([key[first], tree.key[above]])
        log_odds = np.concatenate([log_odds[first], tree.log_odds[above]])
        order = np.argsort(key, kind="stable")
        key, log_odds = key[order], log_odds[order]
    done.append((key, np.zeros(len(key), dtype=np.uint8), log_odds))
    key, depth, log_odds = (np.concatenate(column) for column in zip(*done, strict=True))
    order = np.argsort(key, kind="stable")
    return Octree(tree.resolution, key[order], depth[order], log_odds[order])


def _whole_families(prefix: np.ndarray, log_odds: np.ndarray) -> np.ndarray:
    """Return the rows where eight siblings with one value begin; `prefix` is sorted and unique."""
    first = np.flatnonzero(prefix[:-7] >> 3 == prefix[7:] >> 3) if len(prefix) >= 8 else np.zeros(0, dtype=np.int64)
    family = log_odds[first[:, None] + np.arange(8)]
    return first[(family == family[:, :1]).all(axis=1)]


def expand(tree: Octree) -> Octree:
    """Split every leaf down to depth 16. Memory grows by 8 per level: for small trees and tests."""
    n_cells = 1 << 3 * (DEPTH - tree.depth.astype(np.int64))
    row = np.repeat(np.arange(len(tree)), n_cells)
    within = np.arange(len(row)) - np.repeat(np.cumsum(n_cells) - n_cells, n_cells)
    return Octree(tree.resolution, tree.key[row] + within, np.full(len(row), DEPTH, dtype=np.uint8), tree.log_odds[row])


@dataclass(frozen=True)
class Level:
    """The nodes of one depth, sorted."""

    prefix: np.ndarray  # (M,) int64, key >> 3 * (16 - depth); child number = prefix & 7
    log_odds: np.ndarray  # (M,) float32
    children: np.ndarray  # (M,) uint8, bit i: child i exists; 0 = leaf
    child_code: np.ndarray  # (M,) uint16, two bits a child as .bt has them: 0 unknown, 1 free leaf, 2 occupied leaf, 3 inner
    n_nodes: np.ndarray  # (M,) int64, of the subtree, itself included
    n_inner: np.ndarray  # (M,) int64, inner nodes of the subtree


def levels(tree: Octree, *, parents: str = "max", threshold: float = 0.0) -> list[Level]:
    """Return the nodes from the root (index 0) to depth 16; an empty tree has none at any depth.

    parents : "max" is OctoMap's rule for inner values; "mean" is that of Zhao et al. (14), the mean over all eight children,
        of which an unknown one counts as log-odds 0.
    """
    out: list[Level] = []
    below: Level | None = None
    for depth in range(DEPTH, -1, -1):
        at = tree.depth == depth
        leaf = _leaf_level(tree.key[at] >> 3 * (DEPTH - depth), tree.log_odds[at])
        below = _merge(leaf, _parent_level(below, parents, threshold)) if below is not None else leaf
        out.append(below)
    return out[::-1]


def _leaf_level(prefix: np.ndarray, log_odds: np.ndarray) -> Level:
    n = len(prefix)
    return Level(prefix, log_odds, np.zeros(n, np.uint8), np.zeros(n, np.uint16), np.ones(n, np.int64), np.zeros(n, np.int64))


def _parent_level(level: Level, parents: str, threshold: float) -> Level:
    if not len(level.prefix):
        return level
    first = np.flatnonzero(np.diff(level.prefix >> 3, prepend=-1))
    child = (level.prefix & 7).astype(np.uint16)
    code = np.where(level.children > 0, 3, np.where(level.log_odds >= threshold, 2, 1)).astype(np.uint16)
    if parents == "max":
        log_odds = np.maximum.reduceat(level.log_odds, first)
    else:
        log_odds = (np.add.reduceat(level.log_odds, first, dtype=np.float64) / 8.0).astype(np.float32)
    return Level(
        prefix=level.prefix[first] >> 3,
        log_odds=log_odds,
        children=np.bitwise_or.reduceat(np.uint16(1) << child, first).astype(np.uint8),
        child_code=np.bitwise_or.reduceat(code << 2 * child, first),
        n_nodes=1 + np.add.reduceat(level.n_nodes, first),
        n_inner=1 + np.add.reduceat(level.n_inner, first),
    )


def _merge(a: Level, b: Level) -> Level:
    order = np.argsort(np.concatenate([a.prefix, b.prefix]), kind="stable")
    return Level(**{name: np.concatenate([getattr(a, name), getattr(b, name)])[order] for name in Level.__dataclass_fields__})


def preorder(nodes: list[Level], *, inner_only: bool = False) -> list[np.ndarray]:
    """Return each node's place in a depth-first listing of all nodes, or of the inner ones (a leaf's place then has no meaning)."""
    place = [np.zeros(len(nodes[0].prefix), dtype=np.int64)]
    for above, level in zip(nodes[:-1], nodes[1:], strict=True):
        parent = np.searchsorted(above.prefix, level.prefix >> 3)
        size = level.n_inner if inner_only else level.n_nodes
        before = np.cumsum(size) - size
        first = np.flatnonzero(np.diff(level.prefix >> 3, prepend=-1))
        elder = before - np.repeat(before[first], np.diff(np.append(first, len(level.prefix))))
        place.append(place[-1][parent] + 1 + elder)
    return place
