"""A cloud from straight above in true scale, with the navigation grid over it."""

import cv2
import numpy as np

from slamcli.errors import SlamError
from slamcli.schema import Grid
from slamcli.visualization.render import BACKGROUND, PATH_COLOUR

MARGIN = 0.3  # [m] around the cloud
STRAY_SHARE = 0.001  # of the points may lie outside the picture
OCCUPIED = np.array([200, 30, 60])  # colour of the outlines of what the grid holds for obstacles
FREE = np.array([60, 160, 90])  # tint of what it holds for free floor
FREE_TINT = 0.25  # share of that tint
BAR = 1.0  # [m] of the scale bar


def draw_plan(
    xyz: np.ndarray, rgb: np.ndarray, grid: Grid, *, below: float, size: tuple[int, int], spacing: float, path: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Draw the highest point below a height over each place; returns (H, W, 3) uint8, x to the right, y up, and its pixels per metre.

    xyz : (N, 3) [m], level frame; rgb : (N, 3) uint8; below : m, where the room is cut open
    size : px, width and height that the picture fits into; spacing : m between points; path : (M, 3) camera centres, rows of NaN part it
    """
    is_shown = xyz[:, 2] < below
    if not is_shown.any():
        raise SlamError(f"nothing in the cloud is below {below:g} m: there is no plan to draw")
    xyz, rgb = xyz[is_shown], rgb[is_shown]
    low, high = np.quantile(xyz[:, :2], [STRAY_SHARE, 1.0 - STRAY_SHARE], axis=0) + [[-MARGIN], [MARGIN]]
    scale = float(min(np.array(size) / (high - low)))
    columns, rows = np.maximum(np.floor((high - low) * scale).astype(int), 1)
    picture = _from_above((xyz[:, :2] - low) * scale, xyz[:, 2], rgb, (rows, columns), max(1, int(np.ceil(spacing * scale))))
    picture = _with_grid(picture, grid, low, scale)[::-1].copy()
    if path is not None:
        for piece in np.split(path, np.flatnonzero(~np.isfinite(path[:, 0]))):
            place = (piece[np.isfinite(piece[:, 0]), :2] - low) * scale
            line = np.rint(np.column_stack([place[:, 0], rows - 1 - place[:, 1]])).astype(np.int32)
            cv2.polylines(picture, [line.reshape(-1, 1, 2)], False, PATH_COLOUR, thickness=2, lineType=cv2.LINE_AA)
    _add_bar(picture, scale)
    return picture, scale


def _from_above(place: np.ndarray, z: np.ndarray, rgb: np.ndarray, shape: tuple[int, int], width: int) -> np.ndarray:
    """Paint points at `place` (N, 2) [px], the higher over the lower, each a square `width` px wide."""
    picture = np.empty((*shape, 3), dtype=np.uint8)
    picture[:] = BACKGROUND
    order = np.argsort(z, kind="stable")
    column, row = np.floor(place[order]).astype(np.int64).T
    for down in range(width):
        for right in range(width):
            r, c = row + down - width // 2, column + right - width // 2
            is_in = (r >= 0) & (r < shape[0]) & (c >= 0) & (c < shape[1])
            picture[r[is_in], c[is_in]] = rgb[order][is_in]
    return picture


def _with_grid(picture: np.ndarray, grid: Grid, low: np.ndarray, scale: float) -> np.ndarray:
    """Tint the free floor, and draw the outlines of the obstacles."""
    rows, columns = picture.shape[:2]
    y, x = ((np.arange(n) + 0.5) / scale + low[axis] for n, axis in ((rows, 1), (columns, 0)))
    row = np.floor((y - grid.origin[1]) / float(grid.resolution)).astype(np.int64)
    column = np.floor((x - grid.origin[0]) / float(grid.resolution)).astype(np.int64)
    height, width = grid.state.shape
    is_in = ((row >= 0) & (row < height))[:, None] & ((column >= 0) & (column < width))
    state = np.where(is_in, grid.state[row.clip(0, height - 1)[:, None], column.clip(0, width - 1)], -1)
    is_free, is_occupied = state == 0, (state == 1).astype(np.uint8)
    picture[is_free] = ((1.0 - FREE_TINT) * picture[is_free] + FREE_TINT * FREE).astype(np.uint8)
    outlines, _ = cv2.findContours(is_occupied, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, OCCUPIED.tolist(), thickness=1)
    return picture


def _add_bar(picture: np.ndarray, scale: float) -> None:
    """Draw a bar of one metre in the lower left corner."""
    length, foot = round(BAR * scale), picture.shape[0] - 12
    cv2.rectangle(picture, (12, foot - 4), (12 + length, foot), (0, 0, 0), thickness=-1)
    cv2.putText(picture, f"{BAR:g} m", (12, foot - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
