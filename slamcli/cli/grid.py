"""slamcli export-grid, slamcli plan."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Mount, Target, json_option, mount_option, run_option
from slamcli.errors import SlamError

if TYPE_CHECKING:
    import numpy as np

    from slamcli.navigation.planner import Route
    from slamcli.navigation.walls import Wall
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Grid


class Place(click.ParamType):
    """A place on the floor as x,y in metres."""

    name = "x,y"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float] | str:
        """Read two numbers, or `first` and `last`: below the camera at the recording's first and last frame."""
        if value in ("first", "last"):
            return str(value)
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a place such as 0.5,1.0, first or last", param, ctx)
        return x, y


@click.command("export-grid")
@click.argument("out", type=Target())
@run_option
@click.option("--png", type=Target(), help="Also draw a picture with the trajectory, a scale bar and a legend.")
@click.option("--costs", type=Target(), help="Also write inflation costs (.pgm or .png, mode: scale).")
@click.option("--reach", default=0.55, show_default=True, help="How far costs reach from an obstacle's edge [m].")
@click.option(
    "--falloff", default=10.0, show_default=True, help="How fast costs fall beyond the robot's radius: nav2's cost_scaling_factor [1/m]."
)
@click.option("--radius", type=float, help="The robot's radius, for the costs [m]. [default: the run's robot.radius]")
@click.option(
    "--keep-out",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Polygons, JSON [[[x, y], ...], ...] in metres, or a PNG of the grid's size, not black where to keep out: also write OUT_keepout.",
)
@mount_option
@json_option
def export_grid(
    out: Path, run: str | None, png: Path | None, costs: Path | None, reach: float, falloff: float, radius: float | None,
    keep_out: Path | None, mount: tuple[float, ...] | None, as_json: bool,
) -> None:  # fmt: skip
    """Write the navigation grid OUT (.pgm, .png or .bmp) and its description (.yaml) beside it, for map_server and nav2.

    The first line of the .yaml file is where the recording began: the initial pose of the camera, or with --mount that of the robot's base.

    \b
      slamcli export-grid map.pgm --png map.png
      slamcli export-grid map.pgm --mount 0.1,0,0.3,0,0.2,0
      slamcli export-grid map.pgm --costs costs.pgm --keep-out no_go.json
    """
    import numpy as np

    from slamcli.formats import cost_map, grid_map
    from slamcli.navigation import cost_layers
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Grid

    folder = RunDir.find(run)
    grid = folder.load(Grid, "grid2d")
    warn_without_floor(folder)
    warn_of_doubt(folder)
    start = _start(folder, mount)
    page = grid_map.GridMap.of(grid)
    written: tuple[Path, ...] = grid_map.write(out, page, start=start)
    if png is not None:
        from slamcli.runs.placement import camera_path
        from slamcli.visualization.grid_picture import save_picture

        save_picture(png, grid, trajectory=camera_path(folder), title=str(folder.info()["dataset"]))
        written = (*written, png)
    write_costs = partial(cost_map.write, origin=page.origin, resolution=page.resolution)
    if costs is not None:
        radius = folder.config().robot.radius if radius is None else radius
        written = (*written, *write_costs(costs, cost_layers.inflated(grid, radius=radius, reach=reach, falloff=falloff)))
    if keep_out is not None:
        is_kept_out = _kept_out(grid, keep_out)
        written = (*written, *write_costs(out.with_name(f"{out.stem}_keepout.pgm"), 100 * is_kept_out.astype(np.int16)))
    rows, columns = grid.state.shape
    if as_json:
        about = {"out": [str(path) for path in written], "columns": columns, "rows": rows, "resolution": float(grid.resolution)}
        place = {name: round(value, 9) + 0.0 for name, value in zip(("x", "y", "yaw"), start, strict=True)}
        click.echo(json.dumps(about | {"origin": np.round(grid.origin, 9).tolist(), "start": place}))
        return
    click.echo(f"{', '.join(str(path) for path in written)}: {columns} x {rows} cells of {float(grid.resolution):g} m", err=True)


def _kept_out(grid: Grid, path: Path) -> np.ndarray:
    """Read polygons or a drawn picture as cells (H, W) bool."""
    from slamcli.formats.mask import read_mask
    from slamcli.navigation import cost_layers

    if path.suffix.lower() != ".json":
        return read_mask(path, grid.state.shape)[::-1]
    try:
        polygons = json.loads(path.read_text(encoding="utf-8"))
        return cost_layers.inside_polygons(grid, polygons)
    except (ValueError, TypeError, RecursionError) as error:
        raise SlamError(f"{path}: not a list of polygons [[[x, y], ...], ...]") from error
    except SlamError as error:
        raise SlamError(f"{path}: {error}") from error


def _start(folder: RunDir, mount: tuple[float, ...] | None) -> tuple[float, float, float]:
    """Return x, y, yaw in the level frame of the first frame's camera or, where it is mounted on one, of the robot's base.

    mount : of the command; else the run's robot.mount
    """
    from slamcli.navigation.robot_pose import base_in_camera, base_pose
    from slamcli.runs import placement
    from slamcli.schema import Ground

    told = folder.config().robot.mount
    if mount is None and told:
        try:
            mount = Mount().convert(told, None, None)
        except click.BadParameter as error:
            raise SlamError(f"robot.mount = {error.message}") from error
    if mount is None:
        return placement.read(folder).first
    return base_pose(folder.load(Ground, "densify").T_lw @ placement.camera_poses(folder)[0], base_in_camera(mount))


@click.command()
@click.option(
    "--start",
    type=Place(),
    required=True,
    help="Where the robot is: x,y such as 0.5,1.0 [m], or first or last: below the camera at that frame.",
)
@click.option("--goal", type=Place(), help="Where it should go: x,y [m], first or last.")
@click.option("--reachable", is_flag=True, help="Instead of a path, show how much of the free floor the robot can reach.")
@run_option
@click.option("--map", "page", type=click.Path(path_type=Path, dir_okay=False), help="Plan on this grid map (.yaml) instead of the run's.")
@click.option("--radius", type=float, help="The robot's radius [m]. [default: the run's robot.radius]")
@click.option("--clearance", default=0.3, show_default=True, help="Distance beyond the radius within which obstacles add to the cost [m].")
@click.option("--weight", default=3.0, show_default=True, help="How many times more a metre along an obstacle costs than one in the open.")
@click.option("--allow-unknown", is_flag=True, help="Also drive through cells that were never seen.")
@click.option("-o", "--out", type=Target(), help="Write the path to this file: .csv or .json.")
@click.option("--png", type=Target(own="plan.png"), help="Draw the path. [default: plan.png in the run directory]")
@json_option
def plan(
    start: tuple[float, float] | str, goal: tuple[float, float] | str | None, reachable: bool, run: str | None, page: Path | None,
    radius: float | None, clearance: float,
    weight: float, allow_unknown: bool, out: Path | None, png: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Plan a path on the navigation grid and draw it; prints it as CSV: x,y,clearance in metres, level frame.

    The level frame's origin is below the first camera, x its heading, z up. Cells that were never seen count as blocked.

    \b
      slamcli plan --start first --goal last
      slamcli plan --start 0.5,1.0 --goal 3,2
      slamcli plan --start 0.5,1.0 --goal 3,2 -o path.json --png path.png
      slamcli plan --start first --reachable --radius 0.3
    """
    from slamcli.config.options import Config
    from slamcli.navigation import planner
    from slamcli.runs.placement import camera_path
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Grid
    from slamcli.visualization.grid_picture import save_picture

    trajectory = None
    if page is None:
        folder = RunDir.find(run)
        grid = folder.load(Grid, "grid2d")
        warn_without_floor(folder)
        warn_of_doubt(folder)
        trajectory, title = camera_path(folder), str(folder.info()["dataset"])
        radius = folder.config().robot.radius if radius is None else radius
        png = png or folder.path / "plan.png"
    else:
        grid, title = _read_map(page), page.name
    radius = Config().robot.radius if radius is None else radius
    if reachable:
        start, _ = _ends(grid, start, start, trajectory, radius=radius, allow_unknown=allow_unknown)
        walls = _walls(folder) if page is None else []
        _tell_reachable(grid, start, radius, allow_unknown, walls, png, as_json)
        return
    if goal is None:
        raise click.UsageError("give --goal, or --reachable")
    start, goal = _ends(grid, start, goal, trajectory, radius=radius, allow_unknown=allow_unknown)
    route = planner.plan(grid, start, goal, radius=radius, clearance=clearance, weight=weight, allow_unknown=allow_unknown)
    texts = {".csv": _csv(route), ".json": _json(route, start, goal, radius)}
    if out is not None:
        _write(out, texts)
    if png is not None:
        save_picture(png, grid, trajectory=trajectory, route=route.xy, radius=radius, title=f"{title}: path of {route.length:.2f} m")
    click.echo(texts[".json" if as_json else ".csv"], nl=False)
    least = f"{float(route.clearance.min()) + radius:.2f} m"
    picture = f"; drawn in {png}" if png else ""
    click.echo(f"{route.length:.2f} m, never nearer than {least} to what is not free{picture}", err=True)


def _walls(folder: RunDir) -> list[Wall]:
    """Find the walls in the run's cloud, if it is still there."""
    from slamcli.formats import cloud
    from slamcli.navigation.walls import LEAST_HEIGHT, find_walls

    path = folder.path / "densify" / "cloud.ply"
    xyz, _, normal = cloud.read_ply(path) if path.exists() else (None, None, None)
    return [] if xyz is None or normal is None else find_walls(xyz, normal, least_height=LEAST_HEIGHT)


def _tell_reachable(
    grid: Grid, start: tuple[float, float], radius: float, allow_unknown: bool, walls: list[Wall], png: Path | None, as_json: bool
) -> None:
    """Print the area that a robot can get to from `start` and the rooms that it cannot, and draw what of the free floor it cannot."""
    import numpy as np

    from slamcli.navigation.reach import reach
    from slamcli.schema import Grid
    from slamcli.visualization.grid_picture import save_picture

    found = reach(grid, start, radius=radius, allow_unknown=allow_unknown, walls=walls)
    if png is not None:
        state = np.where((grid.state == 0) & ~found.cells, -1, grid.state).astype(np.int8)
        seen = Grid(grid.p_occupied, grid.n_seen, state, grid.origin, grid.resolution)
        save_picture(png, seen, title=f"white: within reach of a robot of {radius:g} m radius")
    if as_json:
        click.echo(json.dumps({"start": _rounded(start), "radius": radius, **found.to_dict()}))
        return
    drawn = f"; drawn in {png}" if png else ""
    click.echo(f"{found.reached_area:.1f} of {found.free_area:.1f} m2 of free floor are within reach{drawn}")
    if found.rooms_left_out:
        left = ", ".join(
            f"room {room.number} of {room.area:.1f} m2 at {room.middle[0]:.1f},{room.middle[1]:.1f}" for room in found.rooms_left_out
        )
        click.echo(f"out of reach: {left}")


def _ends(
    grid: Grid,
    start: tuple[float, float] | str,
    goal: tuple[float, float] | str,
    path: np.ndarray | None,
    *,
    radius: float,
    allow_unknown: bool,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Turn `first` and `last` into places where the robot has room, and say how far these are from the camera's."""
    import numpy as np

    from slamcli.errors import SlamError
    from slamcli.navigation import planner

    given = {"start": start, "goal": goal}
    places = {name: end for name, end in given.items() if not isinstance(end, str)}
    if len(places) == len(given):
        return places["start"], places["goal"]
    if path is None:
        raise SlamError("--map: a map file does not tell where a camera was; give --start and --goal as x,y")
    known = path[np.isfinite(path).all(axis=1)]
    cameras = {name: known[0 if end == "first" else -1, :2] for name, end in given.items() if isinstance(end, str)}
    found = planner.nearest_room(
        grid, [(float(x), float(y)) for x, y in cameras.values()], radius=radius, allow_unknown=allow_unknown, fixed=list(places.values())
    )
    for (name, camera), place in zip(cameras.items(), found, strict=True):
        off = float(np.linalg.norm(camera - place))
        if off > float(grid.resolution):
            click.echo(f"{name}: {place[0]:.2f},{place[1]:.2f}, the nearest place with room, {off:.2f} m from below the camera", err=True)
        places[name] = place
    return places["start"], places["goal"]


def _csv(route: Route) -> str:
    lines = (f"{x:.4f},{y:.4f},{clear:.4f}\n" for (x, y), clear in zip(route.xy, route.clearance, strict=True))
    return "x,y,clearance\n" + "".join(lines)


def _json(route: Route, start: tuple[float, float], goal: tuple[float, float], radius: float) -> str:
    about = {
        "frame": "level", "start": _rounded(start), "goal": _rounded(goal), "radius": radius, "length": round(route.length, 4),
        "points": [_rounded(xy) for xy in route.xy],
        "clearance": [round(float(v), 4) if v < 1e9 else None for v in route.clearance],
    }  # fmt: skip
    return json.dumps(about) + "\n"


def _rounded(xy: Sequence[float] | np.ndarray) -> list[float]:
    return [round(float(value), 4) + 0.0 for value in xy]


def _write(out: Path, texts: dict[str, str]) -> None:
    from slamcli import files

    if out.suffix not in texts:
        raise SlamError(f"{out}: a path is written as .csv or .json")
    files.write_text(out, texts[out.suffix])


def _read_map(page: Path) -> Grid:
    import numpy as np

    from slamcli.formats import grid_map
    from slamcli.schema import Grid

    read = grid_map.read(page)
    p_occupied = np.where(read.state < 0, np.nan, read.state).astype(np.float32)
    n_seen = (read.state >= 0).astype(np.int32)
    return Grid(p_occupied, n_seen, read.state, np.array(read.origin), np.array(read.resolution))


def warn_without_floor(folder: RunDir) -> None:
    """Say it when heights in this run's grid mean nothing."""
    from slamcli.schema import Ground

    if not folder.load(Ground, "densify").is_found:
        click.echo("Warning: no floor was found in this run, so its grid is not fit to drive on", err=True)


def warn_of_doubt(folder: RunDir) -> None:
    """Say it when a stage found signs that the whole result may be wrong."""
    from slamcli.slam import doubt
    from slamcli.stages import NAMES

    if said := doubt.verdict(doubt.from_records({name: folder.record(name) for name in NAMES})):
        click.echo(f"Warning: {said}", err=True)
