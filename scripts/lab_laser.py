"""The laboratory's rival: a planar laser scanner on the robot and the grid made from its scans, [L] section 4.

Hokuyo URG-04LX as in the paper: 20 to 5600 mm, 240 degrees in steps of 0.36, readings in whole millimetres; accuracy 10 mm near and 1 % far
as its data sheet says. It gets the poses of the camera's own map, so that only the sensors are compared.
"""

import numpy as np

from slamcli.evaluation.grid_truth import TrueRoom, cast
from slamcli.navigation.grid import decide
from slamcli.schema import Grid

NEAR, FAR = 0.02, 5.6  # [m]
HALF_ANGLE, STEP = np.radians(120.0), np.radians(0.36)
MOUNT = 0.2  # [m] above the floor: under the hanging box, over the low one
HIT, MISS, LIMIT = np.log(0.7 / 0.3), np.log(0.4 / 0.6), 4.0  # log-odds of one reading, and their bound


def scan(scene: TrueRoom, T_sc: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Scan from below the true camera pose; returns angles to its heading [rad] and distances [m], NaN = none."""
    angle = np.arange(-HALF_ANGLE, HALF_ANGLE + 1e-9, STEP)
    heading = np.arctan2(T_sc[1, 2], T_sc[0, 2])
    ray = np.column_stack([np.cos(heading + angle), np.sin(heading + angle), np.zeros(len(angle))])
    distance = cast(scene, np.array([*T_sc[:2, 3], MOUNT]), ray)
    noisy = np.round(distance + rng.normal(0.0, 1.0, len(angle)) * np.maximum(0.01, 0.01 * distance) / 3.0, 3)
    return angle, np.where((noisy >= NEAR) & (noisy <= FAR), noisy, np.nan)


def laser_grid(scene: TrueRoom, T_sc: np.ndarray, T_lc: np.ndarray, like: Grid, rng: np.random.Generator) -> Grid:
    """Make a grid with the cells of `like` from scans at the true poses T_sc, entered at the estimated ones T_lc, (N, 4, 4) each."""
    log_odds = np.zeros(like.state.shape)
    n_seen = np.zeros(like.state.shape, dtype=np.int32)
    resolution = float(like.resolution)
    for true, estimated in zip(T_sc, T_lc, strict=True):
        angle, distance = scan(scene, true, rng)
        angle = angle[np.isfinite(distance)] + np.arctan2(estimated[1, 2], estimated[0, 2])
        distance = distance[np.isfinite(distance)]
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        full = _cells(estimated[:2, 3] + distance[:, None] * direction, like)
        along = np.arange(0.0, FAR, 0.5 * resolution)
        ray, step = np.nonzero(along[None, :] < distance[:, None] - resolution)
        free = _cells(estimated[:2, 3] + along[step, None] * direction[ray], like)
        seen = np.setdiff1d(free, full)
        for cells, change in ((full, HIT), (seen, MISS)):
            log_odds.flat[cells] = np.clip(log_odds.flat[cells] + change, -LIMIT, LIMIT)
            n_seen.flat[cells] += 1
    p_occupied = np.where(n_seen > 0, 1.0 / (1.0 + np.exp(-log_odds)), np.nan).astype(np.float32)
    return Grid(p_occupied, n_seen, decide(p_occupied, low=0.35, high=0.6), like.origin, like.resolution)


def _cells(xy: np.ndarray, like: Grid) -> np.ndarray:
    """Return the flat numbers of the cells that hold points (N, 2), each once."""
    column, row = np.floor((xy - like.origin) / float(like.resolution)).astype(np.int64).T
    rows, columns = like.state.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return np.unique(row[inside] * columns + column[inside])
