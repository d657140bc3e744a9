"""Octrees for tests: drawn at random, and of given cells."""

import numpy as np
from hypothesis import strategies as st

from slamcli.geometry import voxel
from slamcli.geometry.octree import CENTRE, DEPTH, Octree, prune

VALUES = np.float32([-2.0, -0.4, 0.85, 3.5])


@st.composite
def trees(draw: st.DrawFn) -> Octree:
    """Small trees near one corner of space, dense enough that siblings merge, some over several levels."""
    corner = draw(st.sampled_from([0, 8**5 * 11, 8**16 - 8**5]))
    n_cells = draw(st.sampled_from([8, 64, 512, 600]))
    keep = draw(st.integers(1, 255))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    cell = np.arange(n_cells)[rng.integers(0, 256, n_cells) <= keep]
    value = VALUES[np.repeat(rng.integers(0, 4, 1 + n_cells // 8), 8)[cell]]
    flip = rng.random(len(cell)) < 0.05
    value[flip] = VALUES[0]
    return Octree(0.05, cell + corner, np.full(len(cell), DEPTH, np.uint8), value)


def as_leaves(tree: Octree) -> dict[tuple[int, int], float]:
    return {(int(d), int(k) >> 3 * (16 - int(d))): float(v) for k, d, v in zip(tree.key, tree.depth, tree.log_odds, strict=True)}


def same(a: Octree, b: Octree) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("key", "depth", "log_odds"))


def tree_of(cells, *, resolution=0.05):
    """An octree from {(x, y, z) cell: occupied}, pruned; cell (0, 0, 0) has its lower corner at the origin."""
    xyz = np.array(sorted(cells), dtype=np.int64).reshape(-1, 3) + CENTRE
    key = voxel.morton(xyz)
    odds = np.array([2.0 if cells[tuple(c)] else -1.0 for c in (xyz - CENTRE).tolist()], dtype=np.float32)
    order = np.argsort(key)
    return prune(Octree(resolution, key[order], np.full(len(key), DEPTH, np.uint8), odds[order]))


def box(x, y, z, occupied):
    return {(i, j, k): occupied for i in range(*x) for j in range(*y) for k in range(*z)}


def hanging_box(*, hollow):
    """A box that hangs at 0.3 m over a floor seen everywhere; its faces are occupied, its inside unknown; air around it."""
    cells = box((-20, 20), (-20, 20), (-1, 0), True) | box((-20, 20), (-20, 20), (0, 6), False)
    around = box((-20, 20), (-20, 20), (6, 12), False)
    inside = box((-4, 5), (-4, 5), (6, 12), False)
    faces = {c: True for c in inside if max(abs(c[0]), abs(c[1])) == 4}
    cells |= {c: v for c, v in around.items() if c not in inside} | faces
    if not hollow:
        cells = {c: v for c, v in cells.items() if c in faces or c not in inside}
    else:
        cells |= {c: False for c in inside if c not in faces}
    return cells
