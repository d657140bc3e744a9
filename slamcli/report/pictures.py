"""The page's pictures: cloud, octree and grid, encoded for embedding."""

import base64
import io
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.errors import Damaged, SlamError
from slamcli.evaluation.run_content import Content
from slamcli.formats import cloud, octomap
from slamcli.navigation import planner
from slamcli.navigation.planner import Route
from slamcli.report.template import thousands
from slamcli.runs import placement
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Features, Grid, Moving
from slamcli.stages import moving_parts
from slamcli.visualization import grid_picture, moving_tint, render

VIEW = render.Viewpoint(width=1200, height=800)
MOST_POINTS = 3_000_000  # of a cloud that is drawn
JPEG_QUALITY = 88
ROBOT_RADIUS = 0.2  # [m]
WITH_DEPTH, WITHOUT_DEPTH = (60, 220, 60), (235, 60, 40)
LEAST_ROUTE = 0.5  # [m] from start to goal, or there is nothing to show
LONGEST_GRID = 6.0  # inches of the grid's longer side
GRID_FONT, GRID_DPI = 10.0, 180  # [pt], [1/inch]: its numbers can be read on a phone


@dataclass(frozen=True)
class Picture:
    """An image as a data URL, and what to say below it."""

    title: str
    caption: str
    url: str  # "" where it could not be drawn; the caption says why


def draw(run: RunDir, content: Content) -> list[Picture]:
    """Draw what the run has."""
    path = content.path
    painters = (
        ("densify", "Point cloud", _cloud),
        ("octree", "Octree", _octree),
        ("grid2d", "Navigation grid", _grid),
        ("extract", "A frame and its features", _frame),
        ("loop", "What moves", _moving),
    )
    found = []
    for stage, title, painter in painters:
        if run.record(stage) is None:
            continue
        try:
            picture = painter(run, title, path)
            found += [] if picture is None else [picture]
        except Damaged:
            raise
        except SlamError as error:
            found.append(Picture(title, f"Not drawn: {error}", ""))
    return found


def _cloud(run: RunDir, title: str, path: np.ndarray) -> Picture:
    file = run.stage_path("densify", "cloud.ply")
    xyz, rgb, normal = cloud.read_ply(file)
    if not len(xyz):
        raise SlamError("the cloud is empty")
    step = -(-len(xyz) // MOST_POINTS)
    rgb = rgb if rgb is not None else np.full((len(xyz), 3), 128, np.uint8)
    spacing = float(run.config().densify.voxel) * step**0.5
    image = render.draw_cloud(xyz[::step], rgb[::step], None if normal is None else normal[::step], spacing=spacing, view=VIEW, path=path)
    return Picture(title, f"{thousands(len(xyz))} points, {file.stat().st_size / 1e6:.1f} MB; the camera's path in red", _jpeg(image))


def _octree(run: RunDir, title: str, path: np.ndarray) -> Picture:
    file, small = run.stage_path("octree", "map.ot"), run.stage_path("octree", "map.bt")
    tree = octomap.read(file)
    sizes = f"map.ot {file.stat().st_size / 1e6:.2f} MB, map.bt {small.stat().st_size / 1e6:.3f} MB"
    image = render.draw_octree(tree, view=VIEW, path=path, with_scale=True)
    low, high = render.octree_heights(tree)
    return Picture(
        title,
        f"occupied cells of {float(tree.resolution):g} m, coloured by height, from {round(low, 1) + 0.0:.1f} m (blue) to {high:.1f} m (red); {sizes}",
        _jpeg(image),
    )


def _grid(run: RunDir, title: str, path: np.ndarray) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    grid = run.load(Grid, "grid2d")
    route = example_route(grid, path)
    rows, columns = grid.state.shape
    size = np.array([columns, rows]) / max(rows, columns) * LONGEST_GRID
    figure = Figure(figsize=tuple(np.maximum(size, 3.5) + [0.8, 1.4]))
    FigureCanvasAgg(figure)
    over = grid_picture.Overlay(path, None if route is None else route.xy, ROBOT_RADIUS, began=placement.read(run).first)
    grid_picture.draw(figure.add_subplot(), grid, over, font=GRID_FONT)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=GRID_DPI, bbox_inches="tight")
    planned = f"; an example path of {route.length:.1f} m for a robot of {ROBOT_RADIUS:g} m radius" if route is not None else ""
    return Picture(title, f"{columns} x {rows} cells of {float(grid.resolution):g} m{planned}", _url("png", buffer.getvalue()))


def _frame(run: RunDir, title: str, path: np.ndarray) -> Picture:
    features = run.load(Features, "extract")
    dataset, counts = run.dataset(), np.diff(features.offset)
    i = int(np.argsort(counts, kind="stable")[len(counts) // 2])
    image = dataset.rgb(i)
    rows = slice(int(features.offset[i]), int(features.offset[i + 1]))
    raw = dataset.camera.distort(features.xy[rows])
    for (x, y), depth, octave in zip(raw, features.depth[rows], features.octave[rows], strict=True):
        centre, radius = (round(float(x)), round(float(y))), round(2.0 * float(features.octave_scale) ** int(octave))
        cv2.circle(image, centre, radius, WITH_DEPTH if np.isfinite(depth) else WITHOUT_DEPTH, 1, cv2.LINE_AA)
    return Picture(
        title, f"frame {i}: {counts[i]} features, green with depth, red without; the circle grows with the pyramid level", _jpeg(image)
    )


def _moving(run: RunDir, title: str, path: np.ndarray) -> Picture | None:
    """Draw the frame in which most moves; nothing where nothing does."""
    moving = run.load(Moving, "loop")
    if not moving.moving.any():
        return None
    share, dataset = moving.moving.mean(axis=(1, 2)), run.dataset()
    i = int(share.argmax())
    image = moving_tint.tinted(dataset.rgb(i), moving, i, dataset.camera)
    said = f"frame {i}: what is tinted moves, {share[i]:.0%} of the view; no pose rests on it and no map shows it"
    return Picture(title, f"{said}; in {int((share > moving_parts.MOVES).sum())} of {len(share)} frames something moves", _jpeg(image))


def example_route(grid: Grid, path: np.ndarray) -> Route | None:
    """Plan through the largest region where the robot fits, from its cell nearest to the camera's start to the one farthest from there."""
    fits = planner.obstacle_distance(grid, allow_unknown=False) >= ROBOT_RADIUS + float(grid.resolution)
    if not fits.any() or not len(path):
        return None
    _, region, statistics, _ = cv2.connectedComponentsWithStats(fits.astype(np.uint8), connectivity=4)
    largest = 1 + int(statistics[1:, cv2.CC_STAT_AREA].argmax())
    xy = (np.argwhere(region == largest)[:, ::-1] + 0.5) * float(grid.resolution) + grid.origin
    start = xy[np.linalg.norm(xy - path[0, :2], axis=1).argmin()]
    goal = xy[np.linalg.norm(xy - start, axis=1).argmax()]
    if np.linalg.norm(goal - start) < LEAST_ROUTE:
        return None
    try:
        return planner.plan(grid, tuple(start.tolist()), tuple(goal.tolist()), radius=ROBOT_RADIUS)
    except SlamError:
        return None


def _jpeg(rgb: np.ndarray) -> str:
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return _url("jpeg", data.tobytes())


def _url(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
