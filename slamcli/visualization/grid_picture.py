"""Pictures of the grid for people: with trajectory, path, scale bar and legend."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.schema import Grid

COLOURS = {"occupied": "#1a1a1a", "free": "#ffffff", "unknown": "#c8c8c8"}
OUT_OF_REACH = "#f5c77e"  # of free floor
TRAJECTORY, ROUTE, START, GOAL, BEGAN = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#c23b22"
LONGEST_SIDE = 11.0  # inches
BAR_LENGTHS = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0])  # [m]


@dataclass(frozen=True)
class Overlay:
    """What is drawn upon a grid, in the level frame."""

    trajectory: np.ndarray | None = None  # (N, 2 or more) [m] camera centres; a row of NaN interrupts the line
    route: np.ndarray | None = None  # (M, 2) [m] planned path
    radius: float = 0.0  # [m] of the robot that it is planned for, and drawn as wide as
    reached: np.ndarray | None = None  # (H, W) bool, cells that a robot can cover; free floor beyond them gets a colour of its own
    ends: Sequence[Sequence[float]] = ()  # x, y [m] of the start, and of a goal, where no route joins them
    gap: tuple[float, float] | None = None  # x, y [m] where a way is too narrow, drawn as a ring
    began: tuple[float, float, float] | None = None  # x [m], y [m], yaw [rad] where the recording began, drawn as an arrow


def save_picture(path: Path, grid: Grid, over: Overlay, *, title: str) -> None:
    """Draw a grid, and what is to be seen upon it, into a PNG, PDF or SVG file; SlamError where the name ends otherwise."""
    path = Path(path)
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise SlamError(f"{path}: not a kind of picture that can be drawn; name it *.png, *.pdf or *.svg")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    extent = _extent(grid)
    size = np.array([extent[1] - extent[0], extent[3] - extent[2]])
    inches = np.maximum(LONGEST_SIDE * size / size.max(), 4.0) + [0.8, 1.4]
    figure = Figure(figsize=tuple(inches))
    FigureCanvasAgg(figure)
    axis = figure.add_subplot()
    draw(axis, grid, over, title=title)
    with files.whole(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), dpi=130, bbox_inches="tight")


def draw(axis: Any, grid: Grid, over: Overlay, *, title: str = "", font: float = 8.0) -> None:
    """Draw a grid into matplotlib axes, x to the right, y up; `font` [pt] of the numbers and the legend."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    extent = _extent(grid)
    colours = {"unknown": COLOURS["unknown"], "free": COLOURS["free"], "occupied": COLOURS["occupied"]}
    shade = grid.state + 1
    if over.reached is not None:
        colours = {"unknown": COLOURS["unknown"], "out of reach": OUT_OF_REACH, "free": COLOURS["free"], "occupied": COLOURS["occupied"]}
        shade = np.where(shade == 0, 0, np.where((shade == 1) & ~over.reached, 1, shade + 1))
    shades = ListedColormap(list(colours.values()))
    axis.imshow(shade, origin="lower", extent=extent, cmap=shades, vmin=0, vmax=len(colours) - 1, interpolation="nearest")
    handles: list[Any] = [Patch(facecolor=colour, edgecolor="#888888", label=name) for name, colour in colours.items()][::-1]
    if over.trajectory is not None and len(over.trajectory):
        handles += axis.plot(over.trajectory[:, 0], over.trajectory[:, 1], color=TRAJECTORY, lw=1.0, label="camera")
    if over.route is not None and len(over.route):
        handles += _draw_route(axis, over.route, over.radius)
    handles += _draw_ends(axis, over.ends)
    if over.gap is not None:
        ring = {"marker": "o", "ms": 16, "mfc": "none", "mec": ROUTE, "mew": 2.5}
        handles += axis.plot(*over.gap, ls="none", label="too narrow", **ring)
    if over.began is not None:
        handles += _draw_began(axis, over.began, extent)
    axis.set_xlim(extent[:2])
    axis.set_ylim(extent[2:])
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]", fontsize=font)
    axis.set_ylabel("y [m]", fontsize=font)
    axis.tick_params(labelsize=font)
    axis.set_title(title, fontsize=10, loc="right")  # the scale bar is at the left
    _scale_bar(axis, extent, font)
    columns = len(handles) if font <= 8.0 else 4
    axis.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.015 * font), ncols=columns, fontsize=font, frameon=False)


def _extent(grid: Grid) -> tuple[float, float, float, float]:
    rows, columns = grid.state.shape
    x, y = grid.origin
    return float(x), float(x + columns * grid.resolution), float(y), float(y + rows * grid.resolution)


def _draw_route(axis: Any, route: np.ndarray, radius: float) -> Sequence[Any]:
    from matplotlib.patches import Circle

    if radius > 0.0:
        for xy in route[:: max(1, len(route) // 400)]:
            axis.add_patch(Circle(xy, radius, facecolor=ROUTE, edgecolor="none", alpha=0.04))
    line = axis.plot(route[:, 0], route[:, 1], color=ROUTE, lw=1.6, label="path")
    return [*line, *_draw_ends(axis, [route[0], route[-1]])]


def _draw_ends(axis: Any, ends: Sequence[Sequence[float]]) -> Sequence[Any]:
    looks = [{"marker": "o", "ms": 7, "color": START, "label": "start"}, {"marker": "X", "ms": 8, "color": GOAL, "label": "goal"}]
    return [line for end, look in zip(ends, looks, strict=False) for line in axis.plot(end[0], end[1], ls="none", **look)]


def _draw_began(axis: Any, began: tuple[float, float, float], extent: tuple[float, float, float, float]) -> Sequence[Any]:
    """Draw where the recording began, and which way it looked."""
    x, y, yaw = began
    length = 0.07 * max(extent[1] - extent[0], extent[3] - extent[2])
    axis.annotate(
        "", (x + length * np.cos(yaw), y + length * np.sin(yaw)), (x, y), arrowprops={"color": BEGAN, "arrowstyle": "-|>", "lw": 2.0}
    )
    return axis.plot([x], [y], marker="o", ms=5, color=BEGAN, ls="none", label="recording began")


def _scale_bar(axis: Any, extent: tuple[float, float, float, float], font: float) -> None:
    """Draw a bar of a round length, some fifth of the width, above the grid's left end, where it hides no cell."""
    width = extent[1] - extent[0]
    length = BAR_LENGTHS[np.argmin(np.abs(np.log(BAR_LENGTHS / (0.2 * width))))]
    above = axis.get_xaxis_transform()  # x in metres, y as a share of the axes' height
    axis.plot([extent[0], extent[0] + length], [1.02, 1.02], color="#000000", lw=3.0, solid_capstyle="butt", transform=above, clip_on=False)
    axis.text(extent[0] + length, 1.02, f"  {length:g} m", fontsize=font, va="center", transform=above)
