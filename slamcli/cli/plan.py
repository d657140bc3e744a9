"""slamcli plan."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Target, json_option, run_option
from slamcli.cli.grid import warn_of_doubt, warn_without_floor
from slamcli.errors import SlamError

if TYPE_CHECKING:
    import numpy as np

    from slamcli.navigation.planner import Route
    from slamcli.navigation.reach import Gap
    from slamcli.navigation.walls import Wall
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Grid


class Place(click.ParamType):
    """A place on the floor as x,y in metres, or in the room as x,y,z."""

    name = "x,y"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...] | str:
        """Read the numbers, or `first` and `last`: where the camera was at the recording's first and last frame."""
        if value in ("first", "last"):
            return str(value)
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        wanted = 3 if ctx is not None and ctx.params.get("flying") else 2
        if len(numbers) != wanted:
            self.fail(f"{value!r} is not a place such as {'0.5,1.0,1.2' if wanted == 3 else '0.5,1.0'}, first or last", param, ctx)
        return numbers


@click.command()
@click.option(
    "--start",
    type=Place(),
    required=True,
    help="Where the robot is: x,y such as 0.5,1.0 [m], or first or last: below the camera at that frame.",
)
@click.option("--goal", type=Place(), help="Where it should go: x,y [m], first or last.")
@click.option("--flying", is_flag=True, is_eager=True, help="Plan through the octree, for what flies; places are x,y,z.")
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
    start: tuple[float, ...] | str, goal: tuple[float, ...] | str | None, flying: bool, reachable: bool, run: str | None, page: Path | None,
    radius: float | None, clearance: float,
    weight: float, allow_unknown: bool, out: Path | None, png: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Plan a path on the navigation grid and draw it, or through the octree; prints it as CSV: x,y,clearance in metres, level frame.

    Clearance is the room beyond the robot's radius. The level frame's origin is below the first camera, x its heading, z up. Cells that were never seen count as blocked.

    \b
      slamcli plan --start first --goal last
      slamcli plan --start 0.5,1.0 --goal 3,2
      slamcli plan --start 0.5,1.0 --goal 3,2 -o path.json --png path.png
      slamcli plan --start first --reachable --radius 0.3
      slamcli plan --flying --start first --goal 3,2,1.5 --radius 0.3
    """
    from slamcli.runs.run_directory import RunDir

    if flying:
        if reachable or page is not None or goal is None:
            raise click.UsageError("--flying goes from --start to --goal through the run's octree; --reachable and --map are for the floor")
        _fly(RunDir.find(run), start, goal, radius, clearance, weight, out, as_json)
        return
    from slamcli.config.options import Config
    from slamcli.navigation import planner
    from slamcli.runs.placement import camera_path
    from slamcli.schema import Grid
    from slamcli.visualization.grid_picture import Overlay, save_picture

    trajectory = height = None
    if page is None:
        folder = RunDir.find(run)
        grid = folder.load(Grid, "grid2d")
        made = folder.record("grid2d")
        assert made is not None, "its grid was loaded"
        height = made["config"]["grid2d"]["band_high"]
        warn_without_floor(folder)
        warn_of_doubt(folder)
        trajectory, title = camera_path(folder), str(folder.info()["dataset"])
        radius = folder.config().robot.radius if radius is None else radius
        png = png or folder.own_file("plan.png")
    else:
        grid, title = _read_map(page), page.name
    radius = Config().robot.radius if radius is None else radius
    if reachable:
        start = _ends(grid, {"start": start}, trajectory, radius=radius, allow_unknown=allow_unknown)[0]["start"]
        walls = _walls(folder, grid) if page is None else []
        _tell_reachable(grid, start, radius, height, allow_unknown, walls, png, as_json)
        return
    if goal is None:
        raise click.UsageError("give --goal, or --reachable")
    ends, moved = _ends(grid, {"start": start, "goal": goal}, trajectory, radius=radius, allow_unknown=allow_unknown)
    start, goal = ends["start"], ends["goal"]
    try:
        route = planner.plan(grid, start, goal, radius=radius, clearance=clearance, weight=weight, allow_unknown=allow_unknown)
    except planner.NoWay as error:
        if png is None:
            raise
        gap = _gap_before(grid, start, goal, radius, allow_unknown)
        _draw_reach(png, grid, [start, goal], gap, radius, allow_unknown, trajectory)
        leads = "" if gap is None else f"; the way leads through {_told(gap)}"
        raise SlamError(f"{error}; {png} shows what can be reached from the start{leads}") from error
    texts = {".csv": _csv(route), ".json": _json(route, start, goal, radius, moved)}
    if out is not None:
        _write(out, texts)
    if png is not None:
        save_picture(png, grid, Overlay(trajectory, route.xy, radius), title=f"{title}: path of {route.length:.2f} m")
    click.echo(texts[".json" if as_json else ".csv"], nl=False)
    least = f"{float(route.clearance.min()) + radius:.2f} m"
    picture = f"; drawn in {png}" if png else ""
    click.echo(f"{route.length:.2f} m for {_robot(radius, height)}, never nearer than {least} to what is not free{picture}", err=True)


def _robot(radius: float, height: float | None) -> str:
    """Say for which robots a plan holds; the height of a map from elsewhere is not known."""
    return f"a robot of {radius:g} m radius" + (f", up to {height:g} m high (grid2d.band_high)" if height is not None else "")


def _fly(
    folder: RunDir, start: tuple[float, ...] | str, goal: tuple[float, ...] | str, radius: float | None, clearance: float, weight: float,
    out: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Plan through the octree; prints the path as CSV: x,y,z,clearance."""
    import numpy as np

    from slamcli.formats import octomap
    from slamcli.navigation import flight
    from slamcli.runs import placement

    space = flight.airspace(octomap.read(folder.stage_path("octree", "map.ot")))
    radius = folder.config().robot.radius if radius is None else radius
    way = placement.camera_path(folder)
    way = way[np.isfinite(way[:, 0])]
    ends: list[tuple[float, ...]] = []
    for name, end in (("start", start), ("goal", goal)):
        if isinstance(end, str):
            camera = way[0 if end == "first" else -1]
            near = flight.nearest_free(space, camera, radius)
            if (off := float(np.linalg.norm(near - camera))) > space.resolution:
                told = ",".join(f"{value:.2f}" for value in near)
                click.echo(f"{name}: {told}, the nearest place with room, {off:.2f} m from the camera", err=True)
            end = tuple(near.tolist())
        ends.append(end)
    route = flight.fly(space, ends[0], ends[1], radius=radius, clearance=clearance, weight=weight)
    rows = np.column_stack([route.xyz, route.clearance])
    about = {"frame": "level", "start": _rounded(ends[0]), "goal": _rounded(ends[1]), "radius": radius, "length": round(route.length, 4),
             "points": np.round(route.xyz, 4).tolist(), "clearance": np.round(route.clearance.astype(float), 4).tolist()}  # fmt: skip
    texts = {
        ".csv": "x,y,z,clearance\n" + "".join(",".join(f"{value:.4f}" for value in row) + "\n" for row in rows),
        ".json": json.dumps(about) + "\n",
    }
    if out is not None:
        _write(out, texts)
    click.echo(texts[".json" if as_json else ".csv"], nl=False)
    click.echo(f"{route.length:.2f} m, never nearer than {float(route.clearance.min()) + radius:.2f} m to what is not free", err=True)


def _walls(folder: RunDir, grid: Grid) -> list[Wall]:
    """Find the walls in the run's cloud, if it is still there: those of its floor plan, so that rooms have the same numbers."""
    from slamcli.formats import cloud
    from slamcli.navigation.floor_plan import walls_of
    from slamcli.navigation.walls import LEAST_HEIGHT

    if not (folder.path / "densify" / "cloud.ply").exists():
        return []
    xyz, _, normal = cloud.read_ply(folder.stage_path("densify", "cloud.ply"))
    return [] if normal is None else walls_of(grid, xyz, normal, wall_height=LEAST_HEIGHT)


def _tell_reachable(
    grid: Grid,
    start: tuple[float, float],
    radius: float,
    height: float | None,
    allow_unknown: bool,
    walls: list[Wall],
    png: Path | None,
    as_json: bool,
) -> None:
    """Print the area that a robot can get to from `start` and the rooms that it cannot, and draw what of the free floor it cannot."""
    from slamcli.navigation.reach import reach
    from slamcli.visualization.grid_picture import Overlay, save_picture

    found = reach(grid, start, radius=radius, allow_unknown=allow_unknown, walls=walls)
    if png is not None:
        save_picture(
            png,
            grid,
            Overlay(reached=found.cells, ends=[start], gap=None if found.gap is None else found.gap.xy),
            title=f"white: within reach of a robot of {radius:g} m radius",
        )
    if as_json:
        click.echo(json.dumps({"start": _rounded(start), "radius": radius, "height": height, **found.to_dict()}))
        return
    drawn = f"; drawn in {png}" if png else ""
    share = found.reached_area / found.free_area if found.free_area else 0.0
    area = f"{found.reached_area:.1f} of {found.free_area:.1f} m2 of free floor ({share:.0%})"
    click.echo(f"{area} are within reach of {_robot(radius, height)}{drawn}")
    if found.gap is not None:
        click.echo(f"{found.area_beyond:.1f} m2 lie beyond {_told(found.gap)}")
    if found.rooms_left_out:
        left = ", ".join(
            f"room {room.number} of {room.area:.1f} m2 at {room.middle[0]:.1f},{room.middle[1]:.1f}" for room in found.rooms_left_out
        )
        click.echo(f"out of reach: {left}")


def _told(gap: Gap) -> str:
    """Say where a way is too narrow, and what can be done about it."""
    x, y = gap.xy
    if gap.is_unseen:
        return f"a gap of {gap.width:.2f} m at {x:.2f},{y:.2f}, beside cells that were never seen: look there, or try --allow-unknown"
    return f"a gap of {gap.width:.2f} m at {x:.2f},{y:.2f}, between obstacles"


def _gap_before(grid: Grid, start: tuple[float, float], goal: tuple[float, float], radius: float, allow_unknown: bool) -> Gap | None:
    import numpy as np

    from slamcli.navigation import planner
    from slamcli.navigation.reach import widest_gap

    there = np.zeros(grid.state.shape, dtype=np.bool_)
    row, column = planner.cells_of(grid, np.array(goal))
    there[row, column] = True
    return widest_gap(grid, start, there, radius=radius, allow_unknown=allow_unknown)


def _draw_reach(
    png: Path,
    grid: Grid,
    ends: list[tuple[float, float]],
    gap: Gap | None,
    radius: float,
    allow_unknown: bool,
    trajectory: np.ndarray | None,
) -> None:
    """Draw what a robot can cover from the first of two places between which there is no way."""
    from slamcli.navigation import cost_layers
    from slamcli.visualization.grid_picture import Overlay, save_picture

    centres = cost_layers.reachable(grid, ends[0], radius=radius, allow_unknown=allow_unknown)
    reached = cost_layers.swept(grid, centres, radius=radius)
    title = f"no way for a robot of {radius:g} m radius; white: within reach"
    save_picture(png, grid, Overlay(trajectory, reached=reached, ends=ends, gap=None if gap is None else gap.xy), title=title)


def _ends(
    grid: Grid, given: dict[str, tuple[float, ...] | str], path: np.ndarray | None, *, radius: float, allow_unknown: bool
) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """Turn `first` and `last` into places where the robot has room, and say how far [m] these are from the camera's; returns both."""
    import numpy as np

    from slamcli.errors import SlamError
    from slamcli.navigation import planner

    places = {name: (end[0], end[1]) for name, end in given.items() if not isinstance(end, str)}
    if len(places) == len(given):
        return places, {}
    if path is None:
        raise SlamError("--map: a map file does not tell where a camera was; give --start and --goal as x,y")
    known = path[np.isfinite(path).all(axis=1)]
    cameras = {name: known[0 if end == "first" else -1, :2] for name, end in given.items() if isinstance(end, str)}
    found = planner.nearest_room(grid, [(float(x), float(y)) for x, y in cameras.values()], radius=radius, allow_unknown=allow_unknown)
    moved = {name: float(np.linalg.norm(camera - place)) for (name, camera), place in zip(cameras.items(), found, strict=True)}
    for (name, off), place in zip(moved.items(), found, strict=True):
        if off > float(grid.resolution):
            click.echo(f"{name}: {place[0]:.2f},{place[1]:.2f}, the nearest place with room, {off:.2f} m from below the camera", err=True)
        places[name] = place
    return places, moved


def _csv(route: Route) -> str:
    lines = (f"{x:.4f},{y:.4f},{clear:.4f}\n" for (x, y), clear in zip(route.xy, route.clearance, strict=True))
    return "x,y,clearance\n" + "".join(lines)


def _json(route: Route, start: tuple[float, float], goal: tuple[float, float], radius: float, moved: dict[str, float]) -> str:
    about = {
        "frame": "level", "start": _rounded(start), "goal": _rounded(goal), "radius": radius, "length": round(route.length, 4),
        "moved": {name: round(metres, 4) for name, metres in moved.items()},
        "points": [_rounded(xy) for xy in route.xy],
        "clearance": [round(float(v), 4) if v < 1e9 else None for v in route.clearance],
    }  # fmt: skip
    return json.dumps(about) + "\n"


def _rounded(xy: Sequence[float] | np.ndarray) -> list[float]:
    return [round(float(value), 4) + 0.0 for value in xy]


def _write(out: Path, texts: dict[str, str]) -> None:
    from slamcli import files

    if out.suffix not in texts:
        raise SlamError(f"{out}: a path is written as .csv or .json; --png draws it")
    files.write_text(out, texts[out.suffix])


def _read_map(page: Path) -> Grid:
    import numpy as np

    from slamcli.formats import grid_map
    from slamcli.schema import Grid

    read = grid_map.read(page)
    p_occupied = np.where(read.state < 0, np.nan, read.state).astype(np.float32)
    n_seen = (read.state >= 0).astype(np.int32)
    return Grid(p_occupied, n_seen, read.state, np.array(read.origin), np.array(read.resolution))
