"""What has moved: cells that are occupied by what was seen first and free by what was seen last, and the frames that can tell.

Key frames are made where the view is new, so a place from which something was taken away may be seen by too few of them to become free.
There, and only there, the frames between are asked too.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.mapping.occupancy import OccupancyMap

MISSES = 2  # in a row: one alone is mostly noise at an edge
CELLS = 16  # doubted cells side by side that are more than an edge
TOUCHING = 1.8  # cells from centre to centre: neighbours by face, edge or corner


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
    for frame, T_lc in poses if len(centre) else []:
        x_c = se3.transform(se3.inverse(T_lc), centre)
        sees = _is_in_view(x_c, camera) & (frame > last_hit)
        if max_range > 0.0:
            sees &= np.linalg.norm(x_c, axis=1) < max_range
        if np.count_nonzero(sees & (missing > 0)) >= CELLS:
            missing[sees] -= 1
            chosen.append((frame, T_lc))
    return chosen[:: -(-len(chosen) // most)] if len(chosen) > most > 0 else chosen


def _vanished(grid: OccupancyMap) -> tuple[np.ndarray, np.ndarray]:
    """Give doubted cells that lie side by side: their centres (N, 3) [m] and the frame of each one's last hit (N,)."""
    centre, last_hit = grid.doubted(MISSES)
    pairs = cKDTree(centre).query_pairs(TOUCHING * grid.resolution, output_type="ndarray")
    adjacency = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(centre), len(centre)))
    _, group = connected_components(adjacency, directed=False)
    is_large = np.bincount(group, minlength=1)[group] >= CELLS
    return centre[is_large], last_hit[is_large]


def _is_in_view(x_c: np.ndarray, camera: Camera) -> np.ndarray:
    """Say of points (N, 3) [m, camera] whether they lie in the picture, lens distortion aside."""
    xy = camera.project(np.where(x_c[:, 2:] > 0.0, x_c, np.nan))
    with np.errstate(invalid="ignore"):
        return ((xy >= 0.0) & (xy < [camera.width, camera.height])).all(axis=1)
