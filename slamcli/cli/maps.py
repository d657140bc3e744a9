"""slamcli export-cloud, export-octree, export-mesh."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Target, check_ending, json_option, run_option, tell_written
from slamcli.errors import SlamError

if TYPE_CHECKING:
    from slamcli.dense.tsdf import Mesh
    from slamcli.runs.run_directory import RunDir

out_argument = click.argument("out", type=Target())


@click.command("export-cloud")
@out_argument
@run_option
@click.option("--frame", type=click.Choice(["level", "world"]), default="level", show_default=True, help="level: z up, floor at z = 0.")
@json_option
def export_cloud(out: Path, run: str | None, frame: str, as_json: bool) -> None:
    """Write the coloured cloud to OUT: .ply and .pcd with normals, .las, .laz and .e57 for surveyors' programs.

    \b
      slamcli export-cloud cloud.ply
      slamcli export-cloud cloud.pcd --frame world
      slamcli export-cloud cloud.laz
    """
    from slamcli.formats import cloud
    from slamcli.geometry import se3
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Ground

    check_ending(out, *cloud.WRITERS)
    folder = RunDir.find(run)
    xyz, rgb, normal = cloud.read_ply(folder.stage_path("densify", "cloud.ply"))
    if frame == "world":
        T_wl = se3.inverse(folder.load(Ground, "densify").T_lw)
        xyz = se3.transform(T_wl, xyz)
        normal = None if normal is None else normal @ T_wl[:3, :3].T
    cloud.write(out, xyz, rgb, normal)
    tell_written(out, as_json, f"{len(xyz)} points", points=len(xyz), frame=frame, bytes=out.stat().st_size)


@click.command("export-octree")
@out_argument
@run_option
@click.option("--colour", is_flag=True, help="Give occupied leaves the cloud's colours: a ColorOcTree (only .ot).")
@json_option
def export_octree(out: Path, run: str | None, colour: bool, as_json: bool) -> None:
    """Write the octree to OUT for OctoMap and octovis: .bt (free or occupied, small) or .ot (with probabilities).

    \b
      slamcli export-octree map.bt
      slamcli export-octree map.ot --colour
    """
    from slamcli import files
    from slamcli.runs.run_directory import RunDir

    suffix, folder = check_ending(out, ".bt", ".ot"), RunDir.find(run)
    if colour:
        if suffix != ".ot":
            raise SlamError(f"{out}: a .bt file has no room for colours; write a .ot file, or leave out --colour")
        _export_colour_octree(out, folder)
    else:
        with open(folder.stage_path("octree", f"map{suffix}"), "rb") as made, files.whole(out) as file:
            shutil.copyfileobj(made, file)
    tell_written(out, as_json, f"{out.stat().st_size} bytes", bytes=out.stat().st_size, frame="level")


def _export_colour_octree(out: Path, folder: RunDir) -> None:
    from slamcli.formats import cloud, octomap

    xyz, rgb, _ = cloud.read_coloured_ply(folder.stage_path("densify", "cloud.ply"))
    tree = octomap.read(folder.stage_path("octree", "map.ot"))
    octomap.write_colour_ot(out, tree, xyz, rgb, parents=folder.config().octree.parents)


@click.command("export-mesh")
@out_argument
@run_option
@click.option("--voxel", type=click.FloatRange(0.002, 0.5), default=0.02, show_default=True, help="Resolution of the surface [m].")
@click.option(
    "--min-area", type=click.FloatRange(0.0), default=0.01, show_default=True, help="Loose parts smaller than this are left out [m2]."
)
@click.option("--triangles", type=click.IntRange(4), help="Decimate to at most this many.")
@click.option(
    "--even-colours/--raw-colours", default=None, help="Even out exposure and white balance. [default: the run's densify.even_colours]"
)
@json_option
def export_mesh(
    out: Path, run: str | None, voxel: float, min_area: float, triangles: int | None, even_colours: bool | None, as_json: bool
) -> None:
    """Make a coloured triangle mesh of the key frames' depth and write it to OUT: .glb, .obj or .ply.

    It is in the level frame (z up, metres); a .glb file has y up, as its standard asks.

    \b
      slamcli export-mesh room.glb
      slamcli export-mesh fine.ply --voxel 0.01
      slamcli export-mesh light.obj --triangles 50000
    """
    from slamcli.dense import mesh_cleaning
    from slamcli.formats.mesh import WRITERS
    from slamcli.runs.run_directory import RunDir

    suffix = check_ending(out, *WRITERS)
    mesh = mesh_cleaning.without_islands(_mesh(RunDir.find(run), voxel, even_colours), min_area=min_area)
    if triangles is not None:
        mesh = mesh_cleaning.decimated(mesh, triangles=triangles)
    if not len(mesh.triangle):
        raise SlamError("the mesh is empty: no key frame has depth within densify.depth_max, or every part is smaller than --min-area")
    WRITERS[suffix](out, mesh.xyz, mesh.triangle, mesh.rgb, mesh.normal)
    n, size = len(mesh.triangle), out.stat().st_size
    tell_written(out, as_json, f"{n} triangles", triangles=n, vertices=len(mesh.xyz), frame="level", bytes=size)


def _mesh(folder: RunDir, voxel: float, even_colours: bool | None) -> Mesh:
    from dataclasses import replace

    from slamcli import console
    from slamcli.dense.tsdf import Volume
    from slamcli.schema import Ground, Moving
    from slamcli.stages import densify
    from slamcli.stages.depth_frames import depth_poses

    config, camera, T_lw = folder.config(), folder.camera("loop"), folder.load(Ground, "densify").T_lw
    option = replace(config.densify, method="tsdf", voxel=voxel)
    poses, read = depth_poses(folder), (folder.dataset(), camera)
    gains, moving = {}, folder.load(Moving, "loop")
    if option.even_colours if even_colours is None else even_colours:
        gains = densify.colour_gains(
            *read, console.progress(poses, "colours"), config.sensor, option, moving=moving, workers=config.run.workers
        )
    volume = Volume(camera, voxel=voxel, depth_max=option.depth_max)
    for view in densify.views(*read, console.progress(poses, "mesh"), config.sensor, option, moving=moving, workers=config.run.workers):
        volume.add(view.seen, view.evened(gains), view.T_wk)
    return volume.mesh().moved(T_lw)
