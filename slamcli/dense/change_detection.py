"""What has moved: cells that are occupied by what was seen first and free by what was seen last, and the frames that can tell.

Key frames are made where the view is new, so a place from which something was taken away may be seen by too few of them to become free.
There, and only there, the frames between are asked too.
"""

import numpy as np

from slamcli.dense.occupancy import OccupancyMap
from slamcli.geometry import se3, voxel
from slamcli.geometry.camera import Camera

MISSES = 2  # in a row: one alone is mostly noise at an edge
CELLS = 16  # doubted cells side by side that are more than an edge
AT_ONCE = 64  # frames: all of a long recording at once would fill the memory
HALF_AROUND = [(x, y, z) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1)][14:]  # neighbours by face, edge or corner, one of two


def witnesses(
    grid: OccupancyMap, poses: list[tuple[int, np.ndarray]], camera: Camera, *, max_range: float, most: int
) -> list[tuple[int, np.ndarray]]:
    """Choose frames that look where something seems to have vanished, after it was last seen, as many as can turn its cells.

    poses : (frame, T_lc (4, 4) camera to the map's frame), in the order of time, of frames not inserted yet
    max_range : of the rays [m], 0 = no limit
    most : frames to choose; of more, every second, third ... is taken: the noise of a sensor can feign change in every view
    """
    centre, last_hit = _vanished(grid)
    missing = np.full(len(centre), grid.looks)
    chosen = []
    for first in range(0, len(poses) if len(centre) else 0, AT_ONCE):
        part = poses[first : first + AT_ONCE]
        T_cl = se3.inverse(np.array([T for _, T in part]))
        x_c = np.einsum("pij,cj->pci", T_cl[:, :3, :3], centre) + T_cl[:, None, :3, 3]
        sees = _is_in_view(x_c, camera) & (np.array([frame for frame, _ in part])[:, None] > last_hit)
        if max_range > 0.0:
            sees &= np.einsum("pci,pci->pc", x_c, x_c) < max_range**2
        for pose, cells in zip(part, sees, strict=True):
            if np.count_nonzero(cells & (missing > 0)) >= CELLS:
                missing[cells] -= 1
                chosen.append(pose)
    return chosen[:: -(-len(chosen) // most)] if len(chosen) > most > 0 else chosen


def _vanished(grid: OccupancyMap) -> tuple[np.ndarray, np.ndarray]:
    """Return doubted cells that lie side by side: their centres (N, 3) [m] and the frame of each one's last hit (N,)."""
    cell, last_hit = grid.doubted(MISSES)
    group = _components(cell)
    is_large = np.bincount(group, minlength=1)[group] >= CELLS
    return grid.centre(cell[is_large]), last_hit[is_large]


def _components(cell: np.ndarray) -> np.ndarray:
    """Number (N,) the groups of touching cells (N, 3): the smallest row in each, spread from neighbour to neighbour."""
    key = voxel.morton(cell)
    order = np.argsort(key)
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for step in HALF_AROUND:
        beside = voxel.morton(cell + step)
        at = order[np.minimum(np.searchsorted(key, beside, sorter=order), len(order) - 1)] if len(order) else order
        touching = np.flatnonzero(key[at] == beside)
        pairs.append(np.column_stack([touching, at[touching]]))
    a, b = np.concatenate(pairs).T
    group, before = np.arange(len(cell)), None
    while before is None or (group != before).any():
        before = group.copy()
        np.minimum.at(group, a, before[b])
        np.minimum.at(group, b, before[a])
        group = group[group]
    return group


def _is_in_view(x_c: np.ndarray, camera: Camera) -> np.ndarray:
    """Say of points (..., 3) [m, camera] whether they lie in the picture, lens distortion aside."""
    xy = camera.project(np.where(x_c[..., 2:] > 0.0, x_c, np.nan))
    with np.errstate(invalid="ignore"):
        return np.all((xy >= 0.0) & (xy < [camera.width, camera.height]), axis=-1)
