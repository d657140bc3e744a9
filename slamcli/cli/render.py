"""slamcli render: pictures and films of the maps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Target, check_ending, json_option, run_option, tell_written
from slamcli.errors import SlamError

if TYPE_CHECKING:
    import numpy as np

    from slamcli.runs.run_directory import RunDir
    from slamcli.visualization.render import Viewpoint

PICTURES, FILM = (".png", ".jpg"), ".mp4"
INSIDE_FIELD_OF_VIEW = 75.0  # [degrees] of films along the way: from inside a room, less shows little


@click.command("render")
@click.argument("out", type=Target())
@run_option
@click.option("--what", type=click.Choice(["cloud", "octree", "plan"]), default="cloud", show_default=True, help="What to draw.")
@click.option("--azimuth", type=float, default=235.0, show_default=True, help="Where the camera stands, from x towards y [degrees].")
@click.option(
    "--elevation", type=click.FloatRange(-89, 89), default=42.0, show_default=True, help="Height of the camera above the horizon [degrees]."
)
@click.option(
    "--size",
    type=(click.IntRange(16, 8192), click.IntRange(16, 8192)),
    default=(1280, 960),
    help="Width and height [px]; default: 1280 960.",
)
@click.option("--path/--no-path", "with_path", default=False, help="Also draw the camera's path.")
@click.option("--below", type=float, default=1.8, show_default=True, help="Height at which a plan cuts the room open [m].")
@click.option("--tour", type=click.Choice(["around", "along"]), default="around", show_default=True, help="The way of a film's camera.")
@click.option("--seconds", type=click.FloatRange(0.1, 600), default=12.0, show_default=True, help="Length of a film [s].")
@json_option
def render_command(
    out: Path, run: str | None, what: str, azimuth: float, elevation: float, size: tuple[int, int], with_path: bool, below: float,
    tour: str, seconds: float, as_json: bool,
) -> None:  # fmt: skip
    """Draw the cloud, the octree or a plan to OUT (.png, .jpg), or film the cloud (.mp4). Needs no display.

    Cloud and octree are seen from outside through the near walls; a plan shows the cloud from above in true scale, with the grid over it.

    \b
      slamcli render cloud.png
      slamcli render octree.png --what octree --azimuth 45
      slamcli render plan.png --what plan --path
      slamcli render tour.mp4 --tour along --size 960 720
    """
    from slamcli.runs import placement
    from slamcli.runs.run_directory import RunDir
    from slamcli.visualization import render

    ending, folder = check_ending(out, *PICTURES, FILM), RunDir.find(run)
    path = placement.camera_path(folder) if with_path else None
    if ending == FILM:
        if what != "cloud":
            raise SlamError(f"{out}: only the cloud is filmed; leave out --what {what}, or draw a picture")
        view = render.Viewpoint(azimuth, elevation, *_even(size))
        n = _film(out, folder, tour, view, seconds, path)
        told = f"{n} frames of {view.width} x {view.height} px"
        tell_written(out, as_json, told, what=what, frames=n, width=view.width, height=view.height)
        return
    if what == "plan":
        image = _draw_plan(folder, below, size, path)
    else:
        view = render.Viewpoint(azimuth_deg=azimuth, elevation_deg=elevation, width=size[0], height=size[1])
        image = (_draw_cloud if what == "cloud" else _draw_octree)(folder, view, path)
    _write_picture(out, ending, image)
    height, width = image.shape[:2]
    tell_written(out, as_json, f"{width} x {height} px", what=what, width=width, height=height)


def _write_picture(out: Path, ending: str, image: np.ndarray) -> None:
    import cv2

    from slamcli import files

    done, data = cv2.imencode(ending, image[..., ::-1])
    if not done:
        raise SlamError(f"{out}: the picture cannot be encoded")
    files.write_bytes(out, data.tobytes())


def _draw_cloud(folder: RunDir, view: Viewpoint, path: np.ndarray | None) -> np.ndarray:
    from slamcli.formats import cloud
    from slamcli.visualization import render

    xyz, rgb, normal = cloud.read_coloured_ply(folder.stage_path("densify", "cloud.ply"))
    return render.draw_cloud(xyz, rgb, normal, spacing=folder.config().densify.voxel, view=view, path=path)


def _draw_octree(folder: RunDir, view: Viewpoint, path: np.ndarray | None) -> np.ndarray:
    from slamcli.formats import octomap
    from slamcli.visualization import render

    return render.draw_octree(octomap.read(folder.stage_path("octree", "map.ot")), view=view, path=path)


def _draw_plan(folder: RunDir, below: float, size: tuple[int, int], path: np.ndarray | None) -> np.ndarray:
    from slamcli.formats import cloud
    from slamcli.schema import Grid
    from slamcli.visualization.plan_view import draw_plan

    xyz, rgb, _ = cloud.read_coloured_ply(folder.stage_path("densify", "cloud.ply"))
    grid, spacing = folder.load(Grid, "grid2d"), folder.config().densify.voxel
    image, scale = draw_plan(xyz, rgb, grid, below=below, size=size, spacing=spacing, path=path)
    click.echo(f"{scale:.1f} px a metre", err=True)
    return image


def _film(out: Path, folder: RunDir, tour: str, view: Viewpoint, seconds: float, path: np.ndarray | None) -> int:
    """Write a film; returns the number of its pictures."""
    from dataclasses import replace

    from slamcli import console
    from slamcli.formats import cloud
    from slamcli.runs import placement
    from slamcli.visualization import render, video

    xyz, rgb, normal = cloud.read_coloured_ply(folder.stage_path("densify", "cloud.ply"))
    n = max(1, round(seconds * video.FRAMES_PER_SECOND))
    if tour == "around":
        eyes = video.round_the_scene(xyz, view, n)
    else:
        eyes = video.along_the_way(placement.level_poses(folder), replace(view, field_of_view_deg=INSIDE_FIELD_OF_VIEW), n)

    def pictures() -> Iterator[np.ndarray]:
        for eye in console.progress(eyes, "film", n):
            yield render.draw_cloud(xyz, rgb, normal, spacing=folder.config().densify.voxel, view=eye, path=path)

    video.write_video(out, pictures())
    return n


def _even(size: tuple[int, int]) -> tuple[int, int]:
    """Round down to what films can be encoded in."""
    return size[0] // 2 * 2, size[1] // 2 * 2
