"""slamcli export-grid."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli import files
from slamcli.cli.common import Mount, Target, json_option, mount_option, run_option
from slamcli.errors import SlamError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Grid


MOUNT_HEIGHT = 0.25  # [m] of a base frame above the floor: wheel hubs are lower
MOUNT_TILT = 0.15  # [rad], more than a floor's slope or a recording's error


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
@click.option(
    "--speed",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help="Areas with their percentage of full speed, JSON [[50, [[x, y], ...]], ...], or a PNG of the grid's size, black without a limit, "
    "else dark for slow: also write OUT_speed.",
)
@mount_option
@json_option
def export_grid(
    out: Path, run: str | None, png: Path | None, costs: Path | None, reach: float, falloff: float, radius: float | None,
    keep_out: Path | None, speed: Path | None, mount: tuple[float, ...] | None, as_json: bool,
) -> None:  # fmt: skip
    """Write the navigation grid OUT (.pgm, .png or .bmp) and its description (.yaml) beside it, for map_server and nav2.

    The first line of the .yaml file is where the recording began: the initial pose of the camera, or with --mount that of the robot's base.

    \b
      slamcli export-grid map.pgm --png map.png
      slamcli export-grid map.pgm --mount 0.1,0,0.3,0,0.2,0
      slamcli export-grid map.pgm --costs costs.pgm --keep-out no_go.json --speed slow.json
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
        from slamcli.visualization.grid_picture import Overlay, save_picture

        save_picture(png, grid, Overlay(camera_path(folder)), title=str(folder.info()["dataset"]))
        written = (*written, png)
    write_costs = partial(cost_map.write, origin=page.origin, resolution=page.resolution)
    if costs is not None:
        radius = folder.config().robot.radius if radius is None else radius
        written = (*written, *write_costs(costs, cost_layers.inflated(grid, radius=radius, reach=reach, falloff=falloff)))
    if keep_out is not None:
        is_kept_out = kept_out(grid, keep_out)
        written = (*written, *write_costs(out.with_name(f"{out.stem}_keepout.pgm"), 100 * is_kept_out.astype(np.int16)))
    if speed is not None:
        written = (*written, *write_costs(out.with_name(f"{out.stem}_speed.pgm"), speed_limits(grid, speed)))
    rows, columns = grid.state.shape
    if as_json:
        about = {"out": [str(path) for path in written], "columns": columns, "rows": rows, "resolution": float(grid.resolution)}
        place = {name: round(value, 9) + 0.0 for name, value in zip(("x", "y", "yaw"), start, strict=True)}
        click.echo(json.dumps(about | {"origin": np.round(grid.origin, 9).tolist(), "start": place}))
        return
    click.echo(f"{', '.join(str(path) for path in written)}: {columns} x {rows} cells of {float(grid.resolution):g} m", err=True)


def kept_out(grid: Grid, path: Path) -> np.ndarray:
    """Read polygons or a drawn picture as cells (H, W) bool."""
    from slamcli.formats.mask import read_mask
    from slamcli.navigation import cost_layers

    if path.suffix.lower() != ".json":
        return read_mask(path, grid.state.shape)[::-1]
    return _from_json(path, partial(cost_layers.inside_polygons, grid), "a list of polygons [[[x, y], ...], ...]")


def speed_limits(grid: Grid, path: Path) -> np.ndarray:
    """Read areas or a drawn picture as percentages of full speed (H, W), 0 = no limit."""
    from slamcli.formats.mask import read_shades
    from slamcli.navigation import cost_layers

    if path.suffix.lower() != ".json":
        return cost_layers.speeds_of_shades(read_shades(path, grid.state.shape)[::-1])
    return _from_json(path, partial(cost_layers.speed_limits, grid), "a list of percentages and polygons [[50, [[x, y], ...]], ...]")


def _from_json(path: Path, make: Callable[[Any], np.ndarray], what: str) -> np.ndarray:
    """Make cells (H, W) of what a JSON file holds; SlamError, which names the file, where that is not `what`."""
    try:
        return make(json.loads(files.read_bytes(path, limit=files.LARGEST_JSON).decode("utf-8")))
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise SlamError(f"{path}: not {what}") from error
    except SlamError as error:
        raise SlamError(f"{path}: {error}") from error


def _start(folder: RunDir, mount: tuple[float, ...] | None) -> tuple[float, float, float]:
    """Return x, y, yaw in the level frame of the first frame's camera or, where it is mounted on one, of the robot's base.

    mount : of the command; else the run's robot.mount
    """
    import numpy as np

    from slamcli.navigation.robot_pose import base_in_camera, base_off_floor, base_pose, upright_mount
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
    ground = folder.load(Ground, "densify")
    T_lc, T_cb = ground.T_lw @ placement.camera_poses(folder)[0], base_in_camera(mount)
    height, tilt = base_off_floor(T_lc, T_cb)
    upright = ",".join(f"{value + 0.0:.3g}" for value in np.round(upright_mount(T_lc, mount), 3))
    if ground.is_found and (abs(height) > MOUNT_HEIGHT or tilt > MOUNT_TILT):
        click.echo(
            f"Warning: with this mount the robot's base is {height:.2f} m above the floor and tilted by {np.degrees(tilt):.0f} degrees, as the "
            f"camera was at {T_lc[2, 3]:.2f} m; it stands upright on the floor with --mount {upright}",
            err=True,
        )
    return base_pose(T_lc, T_cb)


def warn_without_floor(folder: RunDir) -> None:
    """Say it when heights in this run's grid mean nothing."""
    from slamcli.schema import Ground

    if not folder.load(Ground, "densify").is_found:
        click.echo("Warning: no floor was found in this run, so its grid is not fit to drive on", err=True)


def warn_of_doubt(folder: RunDir) -> None:
    """Say it when a stage found signs that the whole result may be wrong."""
    from slamcli.slam import doubt
    from slamcli.stages import NAMES

    if said := doubt.headline(doubt.from_records({name: folder.record(name) for name in NAMES})):
        click.echo(f"Warning: {said}", err=True)
