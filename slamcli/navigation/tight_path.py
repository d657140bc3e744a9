"""Paths of cells pulled tight, on a grid or in space: a straight stretch replaces a run of cells where it costs no more."""

import numpy as np

SLACK = 1.01  # a straight stretch may cost this much more than the cells it replaces: rounding alone must not keep a corner


def pull_tight(cost: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Keep the cells (M, D) between which straight stretches cost no more than the path's own."""
    step = np.linalg.norm(np.diff(cells, axis=0), axis=1)
    value = cost[tuple(cells.T)]
    along = np.concatenate([[0.0], np.cumsum(step * 0.5 * (value[1:] + value[:-1]))])

    def is_as_good(a: int, b: int) -> bool:
        return line_cost(cost, cells[a], cells[b]) <= SLACK * (along[b] - along[a])

    kept, at, last = [0], 0, len(cells) - 1
    while at < last:
        reach = 1
        while at + 2 * reach <= last and is_as_good(at, at + 2 * reach):  # doubling keeps the lines tried few
            reach *= 2
        candidates = range(min(at + 2 * reach, last), at + reach, -1)
        at = next((to for to in candidates if is_as_good(at, to)), at + reach)
        kept.append(at)
    return cells[kept]


def line_cost(cost: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Integrate the cost along the straight line between two cells' centres, sampled four times a cell."""
    length = float(np.linalg.norm(b - a, axis=-1))
    t = np.linspace(0.0, 1.0, int(np.ceil(4.0 * length)) + 1)[:, None]
    cell = np.floor(a + t * (b - a) + 0.5).astype(np.int64)
    value = cost[tuple(cell.T)]
    return float((value.sum() - 0.5 * (value[0] + value[-1])) * length / (len(t) - 1))


def dense(corners: np.ndarray, spacing: float) -> np.ndarray:
    """Add points so that none is farther than `spacing` from the next; drops repeated ones."""
    parts = [corners[:1]]
    for a, b in zip(corners[:-1], corners[1:], strict=True):
        n = int(np.ceil(np.linalg.norm(b - a, axis=-1) / spacing))
        parts.append(a + (b - a) * (np.arange(1, n + 1) / max(n, 1))[:, None])
    return np.concatenate(parts)
